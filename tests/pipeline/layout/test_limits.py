"""What is too large, or has not the period of the drive, is refused at once, before anything is created."""

from __future__ import annotations

import shutil
import time
import tomllib
from collections import namedtuple

import pytest

from magpend_core.engine.checks import SystemCheckError
from pipeline.layout.plan import MOST_CHUNK_BYTES, MOST_TASKS, check_space, make_plan
from pipeline.runs.preview import describe_plan
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.commits import read_commits
from pipeline.store.runfile import read_run
from tests.pipeline.factories import duffing, quietly


def text_of(points=3, starts=2, keep=3, execution=""):
    side = f"{{ start = -1.0, stop = 1.0, num = {starts} }}"
    axes = f"amplitude = {{ start = 0.2, stop = 0.3, num = {points} }}"
    fixed = "[parameters]\nfrequency_hz = 0.2"
    return duffing(axes, f'kind = "grid"\nx = {side}\nv = {side}', n_keep=keep, execution=execution, more=fixed)


def plan_of(**sizes):
    return make_plan(Spec.parse(tomllib.loads(text_of(**sizes))))


def refused(call):
    with pytest.raises(SpecError) as caught:
        call()
    return str(caught.value)


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        (
            {"points": 1_000_000, "starts": 40, "execution": "trajectories_per_task = 16"},
            ("120000000 tasks", f"the limit is {MOST_TASKS}", "execution.trajectories_per_task to 38400 or more"),
        ),
        (
            {"starts": 40, "keep": 1_000_000, "execution": "trajectories_per_task = 1600"},
            ("section: 1600 cells of a task take 25.6 GB", "the limit of compression", "trajectories_per_task to 134"),
        ),
        ({"points": 100_000, "starts": 100, "keep": 1000}, ("needs up to 16 TB", "MAGPEND_SPACE=0")),
    ],
    ids=["tasks", "pieces", "room"],
)
def test_run__refuses_what_is_too_large(write_spec, tmp_path, sizes, words):
    """A run and a dry run say the same within seconds, and create nothing."""
    path, started = write_spec(text_of(**sizes)), time.process_time()
    said = refused(lambda: quietly(path, tmp_path / "run"))
    assert refused(lambda: list(describe_plan(path, tmp_path / "run"))) == said
    assert time.process_time() - started < 60
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert all(word in said for word in words), said


@pytest.mark.slow
def test_make_plan__the_remedies_are_some():
    """The bound of a piece is that of the compressor."""
    from numcodecs import blosc

    plan_of(points=1_000_000, starts=40, execution="trajectories_per_task = 38400")
    plan_of(starts=40, keep=1_000_000, execution="trajectories_per_task = 120")
    assert MOST_CHUNK_BYTES == blosc.MAX_BUFFERSIZE
    for points, starts in ((1_000_000, 40), (10_000_000, 3), (70, 3000), (2, 10_000)):
        plan = plan_of(points=points, starts=starts, keep=60)
        assert plan.n_cells == points * starts**2
        assert plan.n_tasks <= MOST_TASKS


def test_parse_spec__cells_that_nobody_can_count():
    said = refused(lambda: plan_of(points=10_000_000, starts=10_000_000))
    assert "axes.amplitude x initial_conditions.x x initial_conditions.v: 1e+21 cells" in said


def test_make_plan__branches_whose_starts_fill_the_memory():
    data = {
        "kind": "continuation",
        "model": "duffing",
        "axes": {"frequency_hz": {"values": [0.1, 0.2]}},
        "initial_conditions": {"kind": "grid", **{s: {"start": 0.0, "stop": 1.0, "num": 100_000} for s in ("x", "v")}},
    }
    assert "the limit is 10000000" in refused(lambda: make_plan(Spec.parse(data)))


Usage = namedtuple("Usage", "total used free")


def test_check_space__counts_what_is_missing(monkeypatch, tmp_path):
    plan = plan_of(points=1000, starts=10)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: Usage(0, 0, plan.n_bytes // 2))
    with pytest.raises(SpecError, match="needs up to"):
        check_space(plan, tmp_path / "not" / "there")
    check_space(plan, tmp_path, plan.n_cells // 4)
    with pytest.raises(SpecError, match="needs up to"):
        check_space(plan, tmp_path, plan.n_cells)
    check_space(plan, None)
    monkeypatch.setenv("MAGPEND_SPACE", "0")
    check_space(plan, tmp_path)


def test_run__goes_on_where_the_rest_fits(monkeypatch, write_spec, tmp_path):
    """A run that is half done asks for the room of the other half alone."""
    path, out = write_spec(text_of(execution="trajectories_per_task = 2")), tmp_path / "run"
    quietly(path, out)
    info = read_run(out)
    assert len(read_commits(info)) == info.plan.n_tasks > 2
    monkeypatch.setattr(shutil, "disk_usage", lambda place: Usage(0, 0, 10))
    quietly(path, out)  # nothing is missing
    assert any("0.2" in line or "nothing" in line for line in describe_plan(path, out))
    with pytest.raises(SpecError, match="needs up to"):
        quietly(path, tmp_path / "another")
    assert not (tmp_path / "another").exists()


# ---- expressions of time that have not the drive's period ------------------------------------------------

OWN = """
kind = "sweep"
[axes]
frequency_hz = {{ start = 0.5, stop = 1.0, num = 3 }}
[initial_conditions]
kind = "list"
points = [[0.1, 0.2]]
[integration]
n_transient = 1
n_keep = 1
[model]
name = "driven"
[model.states]
x = {{}}
v = {{}}
[model.parameters]
A = 0.5
omega = 3.141592653589793
[model.equations]
x = "v"
v = "-x - v + {drive}"
"""

ODD = [
    "A*cos(omega*t)",  # periodic at the first frequency alone
    "A*sin(pi*f*t)",  # 0 at both ends of the period
    "A*t",
    "x*cos(omega*t)",
    "A*cos(2*pi*f*t) + 0.1*exp(-t)",
]


def test_commands__name_a_state_that_hides_the_rate_of_the_drive(main, write_spec):
    text = OWN.format(drive="A*cos(omega*t)").replace("omega = 3.141592653589793\n", "")
    for old in ("v = {}", '"v"', 'v = "-x - v'):
        text = text.replace(old, old.replace("v", "omega"))
    code, _, err = main("run", write_spec(text), "--dry-run")
    assert code == 2
    assert "Here omega is a state of the model, which hides the drive's." in err


@pytest.mark.parametrize("drive", ODD)
def test_commands__refuse_other_periods_before_anything_is_created(main, write_spec, tmp_path, drive):
    spec = write_spec(OWN.format(drive=drive))
    for command in (["run", spec, "--workers", "0"], ["run", spec, "--dry-run"], ["model", "show", spec]):
        code, _, err = main(*command)
        assert code == 2, err
        assert "does not repeat after a period of the drive" in err
        assert "frequency_hz" in err
        assert list(tmp_path.iterdir()) == [spec]


@pytest.mark.parametrize(
    "drive",
    ["A*cos(2*pi*f*t)", "A*cos(2*pi*phase)", "A*square(phase, 0.3)", "A*cos(2*pi*f*t)**3*x", "A*sign(sin(4*pi*f*t))"],
)
def test_commands__the_drives_period_and_its_fractions(main, write_spec, drive):
    code, _, err = main("model", "show", write_spec(OWN.format(drive=drive)))
    assert code == 0, err


def test_run__a_model_that_fails_its_checks_leaves_no_directory(own, write_spec, tmp_path, monkeypatch):
    """A model given as a Python object is checked only when it is compiled."""
    own.write_module(tmp_path / "models", "slow_drive")
    module = tmp_path / "models/slow_drive.py"
    module.write_text(module.read_text().replace("sincos(c[1] * t)", "sincos(0.3 * c[1] * t)"))
    monkeypatch.syspath_prepend(str(tmp_path / "models"))
    spec = write_spec(own.spec('model = "slow_drive:MINE"'))
    with pytest.raises(SystemCheckError, match="must have the period of the drive"):
        quietly(spec, tmp_path / "out")
    assert not (tmp_path / "out").exists()
