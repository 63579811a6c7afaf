"""The command line: what it prints, what it creates, how it exits."""

from __future__ import annotations

import os
import re
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import pytest
import xarray as xr

import magpend
from pipeline.cli.exits import Exit
from pipeline.layout.plan import make_plan
from pipeline.plots import bifurcation
from pipeline.products.registry import ANALYSES, COMMANDS, FIGURES
from pipeline.runs import preview
from pipeline.runs.preview import figure_command, first_figure
from pipeline.specification import files as workflows
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.run import RunDirectory


@pytest.mark.slow
def test_help__names_the_page_of_exit_codes_once(main):
    (line,) = [line for line in main("--help")[1].splitlines() if "Exit codes:" in line]
    page, _, anchor = line.split()[-1].partition("#")
    text = (Path(__file__).parents[3] / page).read_text("utf-8")
    assert f"## {anchor.replace('-', ' ').capitalize()}" in text.splitlines()
    for code in Exit:
        assert f"| {int(code)} | {code.sentence} |" in text
    for command in (("run",), ("analyse", "attractors"), ("plot", "basins")):
        assert "Exit codes:" not in main(*command, "--help")[1]
    for command in ("run", "status", "verify", "analyse", "plot", "simulate", "models", "presets"):
        assert command in main("--help")[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("verb", "guide", "names"), [("analyse", ANALYSES.groups, COMMANDS), ("plot", FIGURES.groups, tuple(FIGURES))]
)
def test_help__groups_products_by_what_they_need(main, verb, guide, names):
    needs = {name: words for group in guide.values() for name, words in group.items()}
    assert sorted(needs) == sorted(names)
    assert sum(map(len, guide.values())) == len(names)
    lines = main(verb, "--help")[1].splitlines()
    assert [line.rstrip(":") for line in lines if line.rstrip(":") in guide] == list(guide)
    text = " ".join(" ".join(lines).split())
    for name, words in needs.items():
        assert f" {name} " in text
        assert words in text
        if verb == "analyse":
            assert ("noise" in words) == (ANALYSES[name].motion == "noisy")
            assert ("drift" in words) == (ANALYSES[name].motion == "drifting")


REFUSED = {
    "run": "Missing argument",
    "run no-such-workflow": "no-such-workflow",
    "run quickstrt": "did you mean quickstart?",
    "run spce.toml": "spce.toml: no such file; did you mean spec.toml?",
    "run spce": "spce: no such file; did you mean spec.toml?",
    "run spec.toml --workers nan": "--workers",
    "status .": "no run directory",
    "stauts run": "did you mean status",
    "explore . --no-browser": "no run directory",
    "analyse attractors .": "no run directory",
    "analyse basins . --box x": "--box",
    "analyse . attractors": "the directory comes last: magpend analyse attractors .",
    "analyse . nonsense": "unknown magpend analyse '.'",
    "analyse attractors run --treshold 1": "did you mean --",
    "analyse curves run": "Missing option '--second'",
    "branches run": "magpend analyse branches DIR",
    "plot bifurcations run": "did you mean bifurcation",
    "plot bifurcation .": "no run directory",
    "simulate --frequency-hz nan": "frequency",
    "simulate --set q=nan": "q = nan",
    "simulate --psi1 1 --psi1-deg 1": "keep one",
    "simulate --psi1 --no-figure": "--psi1",
    "simulate --model duffing --psi1 1 --no-figure": "unknown state of duffing 'psi1'",
    "simulate --out a.txt": "a.txt",
    "simulate --figure a.gif": "a.gif",
    "zoom spec.toml --psi3 0 1 --out a.toml": "unknown axis 'psi3'; did you mean psi",
    "zoom spec.toml --axis freqency=2:3 --out a.toml": "unknown axis 'freqency'; did you mean frequency_hz",
    "zoom spec.toml --frequency 2.1 --out a.toml": "a name with 2 numbers",
    "nonsense": "nonsense",
}


@pytest.mark.slow
@pytest.mark.parametrize(("line", "sentence"), REFUSED.items())
def test_bad_input__refused_in_a_sentence(main, write_spec, sweep_text, tmp_path, line, sentence):
    write_spec(sweep_text)
    before = sorted(tmp_path.rglob("*"))
    code, out, err = main(*line.split())
    assert (code, out) == (Exit.REFUSED, "")
    assert sentence in err
    assert "Traceback" not in err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_run__dry_run_creates_nothing(main, write_spec, sweep_text, tmp_path):
    write_spec(sweep_text)
    before = sorted(tmp_path.rglob("*"))
    code, out, _ = main("run", "spec.toml", "--dry-run")
    assert code == 0
    axes = "frequency 5, q 2, psi1_0 3, psi2_0 4"
    for words in ("120 cells", axes, "5 of 1 x 2 x 3 x 4 cells", "runs/spec (not created)"):
        assert words in out
    assert sorted(tmp_path.rglob("*")) == before


def sweep_of(axes, **tables):
    """A sweep over so many values of each axis: its plan and specification."""
    values = {name: {"values": [1.5 + i for i in range(n)]} for name, n in axes.items()}
    parameters = {} if "frequency_hz" in axes else {"frequency_hz": 2.2}
    spec = Spec.parse({"kind": "sweep", "parameters": parameters, "axes": values, **tables})
    return SimpleNamespace(spec=spec, plan=make_plan(spec), name="run")


@pytest.mark.parametrize(
    ("axes", "starts", "figure"),
    [
        ({"frequency_hz": 3}, {}, "bifurcation"),
        ({"frequency_hz": 1}, {"psi1": 2, "psi2": 2}, "basins"),
        ({"frequency_hz": 3, "q": 1}, {"psi1": 2, "psi2": 2}, "bifurcation"),
        ({"frequency_hz": 2, "q": 2}, {"psi1": 2}, "regimes"),
        ({}, {"psi1": 2, "psi2": 2, "psi1_dot": 2}, "basins"),
        ({}, {"psi1": 2}, "gallery"),
    ],
)
def test_first_figure__fits_the_axes(axes, starts, figure):
    grid = {name: {"start": 0.0, "stop": 1.0, "num": n} for name, n in starts.items()}
    assert first_figure(sweep_of(axes, initial_conditions={"kind": "grid", "psi1": 0.1, **grid})) == figure


@pytest.mark.parametrize(
    ("axes", "products", "n_keep", "command"),
    [
        ({"frequency_hz": 2, "q": 2}, {"lyapunov": {}}, 64, "magpend plot lyapunov run --map"),
        ({"frequency_hz": 3}, {"lyapunov": {}}, 64, "magpend plot lyapunov run"),
        ({}, {"lyapunov": {}}, 64, "magpend plot convergence run"),
        ({"frequency_hz": 2, "q": 2}, {}, 64, "magpend plot regimes run"),
        ({}, {}, 1000, "magpend plot section run"),
    ],
)
def test_figure_command__fits_the_products(axes, products, n_keep, command):
    starts = {"kind": "random", "n": 3, "psi1": [0.0, 1.0]}
    run = sweep_of(axes, initial_conditions=starts, products=products, integration={"n_keep": n_keep})
    assert figure_command(run) == command


WELL = "x' = v\nv' = x - x**3 - d*v + A*cos(2*pi*f*t)\nd = 0.15\nA = 0.2"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tables", "hint"),
    [
        ({"noise": {"strengths": {"v": 0.05}, "steps_per_period": 64}}, "section run"),
        ({"drift": {"A": {"from": 0.2, "to": 0.3, "rate_per_period": 0.01}}}, "drift run"),
        ({"axes": {n: {"values": [0.15, 0.2]} for n in ("A", "d", "frequency_hz")}}, "regimes run --at frequency=0.2"),
        ({"axes": {"A": {"values": [0.2, 0.3]}}, "initial_conditions": {"kind": "random", "n": 2}}, "bifurcation run"),
    ],
    ids=["noise", "drift", "three axes", "one axis"],
)
def test_hint_after_a_run__is_a_figure_that_the_run_can_draw(main, tables, hint, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    start = {"kind": "list", "points": [[0.1, 0.0]]}
    frequency = {} if "frequency_hz" in tables.get("axes", {}) else {"frequency_hz": 0.159}
    magpend.run(
        {"kind": "sweep", "model": WELL, "parameters": frequency, "initial_conditions": start}
        | {"integration": {"n_transient": 10, "n_keep": 4}, **tables},
        "run",
        workers=0,
        echo=lambda _: None,
    )
    command = figure_command(RunDirectory.open("run"))
    assert command == f"magpend plot {hint}"
    code, _, err = main(*command.split()[1:])
    assert code == 0, err
    name, _, rest = hint.partition(" run")
    assert f"run.plot.{name}({'at={' if rest else ')'}" in repr(magpend.Run.open("run"))


@pytest.mark.slow
def test_run__plot_of_two_parameters_draws_a_diagram_and_says_what_is_left(main, write_spec, sweep_text):
    write_spec(sweep_text)
    code, out, err = main("run", "spec.toml", "--workers", "0", "--plot")
    assert code == 0, err
    assert out.splitlines()[-3:] == [
        "figure: runs/spec/figures/bifurcation_psi1_q_1.6.png",
        "data: runs/spec/figures/bifurcation_psi1_q_1.6.nc",
        "left out: q is drawn at 1.6, one of 2 values. See: magpend plot regimes runs/spec",
    ]


@pytest.mark.slow
def test_run__status__verify__plot(main, write_spec, walk_text, tmp_path, monkeypatch):
    write_spec(walk_text + "\n[smoke]\ninitial_conditions.n = 2\n")
    code, out, _ = main("run", "spec.toml", "--smoke", "--workers", "0", "--plot")
    assert code == 0
    assert "cube: runs/spec-smoke/cube.zarr" in out
    assert out.splitlines()[-2:] == [
        "figure: runs/spec-smoke/figures/bifurcation_psi1.png",
        "data: runs/spec-smoke/figures/bifurcation_psi1.nc",
    ]
    directory = tmp_path / "runs" / "spec-smoke"
    with monkeypatch.context() as patch:  # a figure that cannot be drawn is no error of a finished run
        patch.setattr(
            bifurcation, "plot_bifurcation", lambda *_, **__: (_ for _ in ()).throw(ValueError("no paint left"))
        )
        code, out, _ = main("run", "spec.toml", "--smoke", "--workers", "0", "--plot")
    assert code == 0
    assert "no figure:" in out
    assert "no paint left" in out
    assert "draw it with: magpend plot bifurcation runs/spec-smoke" in out
    assert (directory / "figures" / "bifurcation_psi1.png").stat().st_size > 0

    code, out, _ = main("status", directory)
    assert code == 0
    assert "complete" in out
    assert "24 of 24 cells (100.0 %), 4 of 4 tasks" in out
    assert re.search(r"bounded +\d+ ", out)

    assert main("verify", directory)[0] == 0
    code, out, _ = main("plot", "bifurcation", directory, "--state", "psi2", "--degrees", "--format", "svg")
    assert code == 0
    assert (directory / "figures" / "bifurcation_psi2_degrees.svg").read_text().startswith("<?xml")

    code, _, err = main("plot", "bifurcation", directory, "--layout", "side", "--out", tmp_path / "a.pdf")
    assert code == 0
    chunk = next((directory / "cube.zarr" / "section").glob("c.*"))
    chunk.write_bytes(chunk.read_bytes()[:-1] + b"\0")
    code, out, _ = main("verify", directory)
    assert code == Exit.DAMAGED
    assert "--repair" in out
    code, _, err = main("plot", "bifurcation", directory)
    assert code == Exit.DAMAGED
    assert "magpend verify" in err
    assert main("verify", directory, "--repair")[0] == 0
    code, out, _ = main("status", directory)
    assert "incomplete" in out
    assert "pending" in out
    assert main("run", "spec.toml", "--smoke", "--workers", "0")[0] == 0
    assert main("verify", directory)[0] == 0


def test_run__locked_directory_has_its_own_code(main, write_spec, sweep_text, tmp_path):
    from filelock import FileLock

    write_spec(sweep_text)
    (tmp_path / "run").mkdir()
    with FileLock(tmp_path / "run" / "lock", is_singleton=False):
        code, _, err = main("run", "spec.toml", "--out", "run", "--workers", "0")
    assert code == Exit.LOCKED
    assert "another magpend run" in err


def test_run__failed_task_has_its_own_code(main, write_spec, sweep_text, monkeypatch):
    from pipeline.compute import task

    write_spec(sweep_text)
    monkeypatch.setattr(task, "compute", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    code, _, err = main("run", "spec.toml", "--workers", "0")
    assert code == Exit.FAILED
    assert "No space left on device" in err


@pytest.mark.slow
def test_simulate__series_figure_and_data_with_provenance(main, tmp_path):
    words = ("simulate", "--psi1-deg", "10", "--periods", "2", "--samples", "20", "--out")
    assert main(*words, "a.nc")[1].split() == ["series:", "a.nc", "figure:", "a.png"]
    code, out, _ = main(*words, "b.csv")
    assert code == 0
    assert out.split() == ["series:", "b.csv", "figure:", "b.png", "data:", "b.nc"]
    with xr.open_dataset(tmp_path / "b.nc", engine="scipy") as stored:
        assert {"psi1", "path"} <= set(stored.data_vars)
        assert {"created", "host", "versions", "parameters", "model"} <= set(stored.attrs)
    assert stored.attrs["host"].encode() in (tmp_path / "b.png").read_bytes()
    assert main("simulate", "--periods", "2", "--no-figure")[0] == 0
    assert not (tmp_path / "trajectory.png").exists()


def test_presets__values_units_and_source(main):
    _, out, _ = main("presets")
    assert re.search(r"m1 .*4\.275.*kg.*mass of link 1.*paper", out)
    assert re.search(r"delta .*0\.003265.*m .*calibrated", out)


@pytest.mark.slow
def test_find_spec__shipped_workflows():
    shipped = workflows.shipped_workflows()
    assert "quickstart" in shipped
    assert workflows.find_spec("quickstart") == shipped["quickstart"]
    for path in shipped.values():
        for smoke in (False, True):
            # the lines before that of the time, which is measured
            lines = islice(preview.describe_plan(path, os.devnull + "-absent", smoke=smoke), 3)
            assert any("cells (" in line for line in lines)


def test_find_spec__of_the_gallery_by_its_folder_and_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = "gallery/ueda-attractor"
    assert workflows.find_spec(name) == workflows.shipped_workflows()[name]
    assert workflows.default_directory(workflows.find_spec(name), smoke=False) == Path("runs/ueda-attractor")
    with pytest.raises(SpecError, match="did you mean gallery/ueda-attractor"):
        workflows.find_spec("gallery/ueda-atractor")
    assert workflows.find_spec("mine/ueda-attractor") == Path("mine/ueda-attractor")
    (tmp_path / "gallery").mkdir()
    (tmp_path / name).write_text("", "utf-8")  # a file of one's own comes first
    assert workflows.find_spec(name) == Path(name)
