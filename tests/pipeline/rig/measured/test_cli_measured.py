"""``magpend measured``: from files on the disk to tables and figures."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from pipeline.rig.recordings import write_raw
from pipeline.rig.virtual import DriveSensor, Sensor, Step, readings

from .conftest import RIGHT

FREQUENCIES = (2.46, 2.48, 2.54, 2.56)
FEW = ("--transient", 50)


@pytest.fixture(scope="module")
def files(tmp_path_factory, pendulum):
    """A file of a sweep with potentiometers of 12 bits, and its mapping."""
    folder = tmp_path_factory.mktemp("rig")
    steps = [Step(f, 90) for f in FREQUENCIES]
    times = np.arange(0.0, sum(s.duration_s for s in steps) - 1e-3, 1e-3)
    angle = Sensor("potentiometer", noise=1e-3, bits=12, dead_band=0.1)
    sensors = {"psi1": angle, "psi2": angle, "drive": DriveSensor("signal", 0.02)}
    raw, mapping = readings(pendulum, steps, RIGHT, times, sensors=sensors, seed=4)
    write_raw(raw, folder / "up.csv")
    text = 'time = { channel = "time" }\n' + mapping.toml()
    (folder / "rig.toml").write_text(text, "utf-8")
    (folder / "no_drive.toml").write_text(
        text.split("[drive]")[0].replace("[channels.psi1]", 'drive = "none"\n[channels.psi1]', 1), "utf-8"
    )
    return folder


@pytest.mark.slow
def test_measured_steps__prints_json(main, files):
    code, out, _ = main("measured", "steps", files / "up.csv", "--mapping", files / "rig.toml", *FEW, "--json")
    rows = json.loads(out)
    assert code == 0
    assert [r["orbit_period"] for r in rows] == [2, 2, 1, 1]
    assert {r["side"] for r in rows} == {"right"}
    assert [r["frequency_hz"] for r in rows] == pytest.approx(FREQUENCIES, abs=2e-4)


@pytest.mark.slow
def test_measured_compare__writes_figures_tables_and_numbers(main, files, run_directory, tmp_path):
    words = ("measured", "compare", run_directory, files / "up.csv", "--mapping", files / "rig.toml", *FEW)
    code, out, err = main(*words, "--out", tmp_path / "out")
    assert code == 0, err
    assert "sides agree at 100 % of the 4 steps that are sure" in out
    assert "1 window edge" in out
    names = {p.name for p in (tmp_path / "out").iterdir()}
    assert names == {f"{n}.{s}" for n in ("comparison", "beside", "over") for s in ("png", "nc")} | {
        "steps.csv",
        "edges.csv",
    }
    with (tmp_path / "out" / "steps.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [r["computed_side"] for r in rows] == ["right"] * 4
    assert [float(r["distance_in_noise"]) < 2.5 for r in rows] == [True] * 4
    with (tmp_path / "out" / "edges.csv").open() as file:
        assert next(csv.DictReader(file))["before"] == "period 2, right"


@pytest.mark.slow
def test_measured_diagram__alone_and_with_a_run(main, files, run_directory, tmp_path):
    words = ("measured", "diagram", files / "up.csv", "--mapping", files / "rig.toml", *FEW)
    for name, says, more in (
        ("a.png", "unknown state 'psi3'", ("--state", "psi3")),
        ("gone/a.png", "no such folder", ()),
    ):
        code, _, err = main(*words, "--out", tmp_path / name, *more)
        assert (code, says in err) == (2, True)
    for name, more in (("a.png", ()), ("b.svg", ("--run", run_directory, "--layout", "over", "--degrees"))):
        code, out, err = main(*words, "--out", tmp_path / name, *more)
        assert code == 0, err
        assert (tmp_path / name).stat().st_size > 1000
        assert (tmp_path / name).with_suffix(".nc").exists()
        assert out.startswith(f"figure: {tmp_path / name}")


@pytest.mark.slow
def test_measured_series__prints_how_far_off_it_is(main, files, tmp_path):
    words = ("measured", "series", files / "up.csv", "--mapping", files / "rig.toml", "--out", tmp_path / "s.png")
    code, out, err = main(*words, "--start-s", 100, "--periods", 4)
    assert code == 0, err
    assert out.startswith("rms of psi1: 0.0")
    assert (tmp_path / "s.png").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"mapping": "no_drive.toml"}, "no drive channel"),
        ({"more": ("--max-period", 0)}, "max_period = 0"),
        ({"recording": "gone.csv"}, "gone.csv"),
        ({"more": ("--csv", "/nowhere/at/all.csv")}, "--csv"),
    ],
)
def test_measured_steps__bad_input_exits_with_2(main, files, change, says):
    recording, mapping = files / change.get("recording", "up.csv"), files / change.get("mapping", "rig.toml")
    code, _, err = main("measured", "steps", recording, "--mapping", mapping, *change.get("more", ()))
    assert code == 2
    assert says in err
    assert "Traceback" not in err


@pytest.mark.slow
def test_measured__what_does_not_fit_is_refused_before_anything_is_read(main, files, run_directory, tmp_path):
    sine, rig = files / "sine.toml", files / "rig.toml"
    sine.write_text(rig.read_text().replace('"pendulum"', '"pendulum-sine"', 1), "utf-8")
    other = ("compare", run_directory, files / "gone.csv", "--out", tmp_path / "out", "--mapping")
    two = ("steps", files / "up.csv", files / "up.csv", "--mapping", rig, "--mapping")
    for words, says in (
        ((*other, sine), "a run of the model pendulum, while the recordings' mapping says pendulum-sine"),
        ((*other, rig, "--at", "q=1.5"), "unknown axis 'q'"),
        ((*two, sine), "several models (pendulum, pendulum-sine"),
        ((*two, rig, files / "up.csv"), "2 for 3 recordings"),
    ):
        code, _, err = main("measured", *words)
        assert (code, says in err) == (2, True), err
