"""Runs whose drive is a recording: the numbers of ordinary ones, the same bytes whatever happens."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from pipeline import open_run
from pipeline.compute import task
from pipeline.motion.recorded import Recorded
from pipeline.runs.derive import derive
from pipeline.runs.drawing import figure
from pipeline.runs.extend import extend
from pipeline.runs.run import run
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.runfile import read_run
from tests.pipeline.factories import edges, finished, quietly, silent

HZ = 2.2
CELLS = """
[axes]
q = { values = [0.6, 1.6] }
[initial_conditions]
kind = "grid"
psi1_deg = { start = -30, stop = 30, num = 3 }
psi2_deg = { start = -20, stop = 20, num = 4 }
[integration]
n_transient = 7
n_keep = 4
[execution]
trajectories_per_task = 6
"""
RECORDED = f'kind = "sweep"\n[drive]\nfile = "drive.csv"\n{CELLS}'
ORDINARY = f'kind = "sweep"\n[parameters]\nfrequency_hz = {HZ}\n{CELLS}'
EXTREMES = '[products]\nextremes = { quantities = ["drive_torque"] }\n'


@pytest.fixture
def recorded(write_spec, tmp_path):
    """Write a specification and its drive file; returns the path of the former."""

    def write(text=RECORDED, drive=None):
        (tmp_path / "drive.csv").write_text(drive or edges(12, HZ, jitter=0.01), "utf-8")
        return write_spec(text)

    return write


@pytest.mark.slow
def test_run__equal_periods_give_the_numbers_of_the_ordinary_run(recorded, write_spec, tmp_path):
    quietly(recorded(RECORDED + EXTREMES, edges(12, HZ)), tmp_path / "recorded")
    quietly(write_spec(ORDINARY + EXTREMES), tmp_path / "ordinary")
    one, other = open_run(tmp_path / "recorded").load(), open_run(tmp_path / "ordinary").load()
    assert one.section.dims == other.section.dims
    # 11 periods at rtol 1e-8, of cells that are not yet settled
    np.testing.assert_allclose(one.section, other.section, atol=1e-6)
    np.testing.assert_allclose(one.extremes, other.extremes, atol=1e-6)
    for name in ("turns", "status", "orbit_period", "n_periods"):
        assert np.array_equal(one[name], other[name]), name
    assert float(one.frequency) == pytest.approx(HZ)
    assert one.frequency.attrs["long_name"] == "mean frequency of the recorded drive"


def torque(n=1200):
    """The model's own wave, sampled; it begins low, so that its first rising edge is in it."""
    times = np.linspace(0, 5, n + 1)
    level = np.where(np.mod(times * HZ, 1) > 0.5, 1.6, -1.6)
    rows = [f"{t!r},{x!r}" for t, x in zip(times.tolist(), level.tolist(), strict=True)]
    return "\n".join(["time_s,drive", *rows]) + "\n"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["edges", "torque"])
def test_run__same_numbers_in_other_tasks(recorded, tmp_path, kind):
    text = RECORDED.replace("n_transient = 7", "n_transient = 5")
    path = recorded(text.replace("q = {", "T1 = {"), torque()) if kind == "torque" else recorded(text)
    quietly(path, tmp_path / "whole")
    path.write_text(path.read_text("utf-8").replace("per_task = 6", "per_task = 5"), "utf-8")
    # a worker reads the drive from run.json, not from its file
    run(path, tmp_path / "other", workers=1, echo=silent)
    one, other = open_run(tmp_path / "whole").load(), open_run(tmp_path / "other").load()
    assert one.drop_attrs(deep=False).identical(other.drop_attrs(deep=False))


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    """A finished run under a recording, beside its files."""
    folder = tmp_path_factory.mktemp("recorded")
    (folder / "drive.csv").write_text(edges(12, HZ, jitter=0.01), "utf-8")
    finished(folder, RECORDED)
    return folder


@pytest.fixture
def path(once, tmp_path):
    """A copy of it: its specification, beside the drive's file and the run."""
    shutil.copytree(once, tmp_path, dirs_exist_ok=True)
    return tmp_path / "spec.toml"


@pytest.mark.slow
def test_run__explains_itself_when_the_file_is_gone(path, tmp_path):
    text = (tmp_path / "drive.csv").read_text("utf-8")
    (tmp_path / "drive.csv").unlink()
    spec = Spec.parse(read_run(tmp_path / "run").spec)
    assert spec.drive.text == text
    assert open_run(tmp_path / "run").section.notnull().all()
    assert figure(tmp_path / "run", "bifurcation").axes
    assert figure(tmp_path / "run", "section", {"at": {"q": 1.6}}).axes


def test_run__with_another_drive_is_refused(path, recorded, tmp_path, bytes_of):
    before = bytes_of(tmp_path / "run")
    recorded(drive=edges(12, HZ, jitter=0.02))
    with pytest.raises(RefusedError, match=r"spec\.drive\.sha256"):
        quietly(path, tmp_path / "run")
    assert bytes_of(tmp_path / "run") == before


def test_run__damaged_drive_is_found_and_rebuilt(path, tmp_path, bytes_of):
    directory = tmp_path / "run"
    before, file = bytes_of(directory), directory / "run.json"
    data = json.loads(file.read_text("utf-8"))
    data["spec"]["drive"]["text"] = data["spec"]["drive"]["text"].replace("3.", "4.", 1)
    file.write_text(json.dumps(data), "utf-8")
    with pytest.raises(DamagedError, match=r"run\.json: damaged"):
        open_run(directory)
    quietly(path, directory)
    assert bytes_of(directory) == before


def test_derive__refuses_what_goes_on_beyond_the_recording(once):
    for name in ("attractors", "basins", "chaos", "settling"):
        with pytest.raises(
            SpecError, match=rf"recording drive\.csv, which ends; {name} needs a run at a fixed frequency"
        ):
            derive(once / "run", name)
    with pytest.raises(SpecError, match="attractors needs a run at a fixed frequency"):
        figure(once / "run", "gallery", {"at": {"q": 1.6}})


@pytest.mark.slow
def test_extend__cells_under_the_same_recording(once, recorded, tmp_path, bytes_of, monkeypatch):
    wider = recorded(RECORDED.replace("[0.6, 1.6]", "[0.6, 1.1, 1.6]"))
    quietly(wider, tmp_path / "fresh")
    calls = []
    original = Recorded.integrate

    def counted(motion, inputs, quantities):
        calls.append(len(inputs.initial_states))
        return original(motion, inputs, quantities)

    monkeypatch.setattr(Recorded, "integrate", counted)
    monkeypatch.setattr(task, "warm_up", lambda spec: 0.0)
    extend(once / "run", wider, tmp_path / "new", workers=0, echo=silent)
    assert sum(calls) == 12
    assert bytes_of(tmp_path / "new") == bytes_of(tmp_path / "fresh")
    with pytest.raises(RefusedError, match="cells under a recorded drive do not go on"):
        extend(once / "run", keep=5, out=tmp_path / "longer", echo=silent)
    other = recorded(drive=edges(12, HZ, jitter=0.02))
    with pytest.raises(RefusedError, match=r"drive\.sha256"):
        extend(once / "run", other, tmp_path / "other", echo=silent)
