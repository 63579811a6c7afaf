"""From a recording to a drive file, and on to a simulation and a run."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from pipeline.rig.drive_file import drive_file
from pipeline.rig.recordings import read_recording
from pipeline.specification.problems import SpecError
from pipeline.specification.recorded_drive import load_drive, parse_drive

RIG = """
model = "pendulum"
sampling_rate_hz = 1000.0
seed = 3
initial_state = { psi1 = 0.3 }
[drive]
kind = "torque"
noise = 0.005
steps = [{ frequency_hz = 2.2, n_periods = 8 }, { frequency_hz = 2.3, n_periods = 8, duty_cycle = 0.55 }]
[sensors.psi1]
kind = "encoder"
[sensors.psi2]
kind = "encoder"
"""


def recording(level, rate_hz=1000.0, piece=None, kind="torque"):
    time = np.arange(len(level)) / rate_hz
    pieces = np.zeros(len(level), int) if piece is None else piece
    return xr.Dataset(
        {"drive": ("sample", level, {"kind": kind, "units": "N m"})},
        coords={"time": ("sample", time), "piece": ("sample", pieces)},
        attrs={"file": "rig.tdms", "sha256": "abc"},
    )


def wave(n=5000, hz=2.0, duty=0.4):
    """A switching torque with flanks of some samples, that begins low."""
    phase = np.mod(np.arange(n) / 1000.0 * hz + 0.7, 1.0)
    return 1.5 * np.tanh(200 * np.minimum(phase, np.minimum(duty - phase, 1.0)).clip(-0.05, 0.05))


def test_drive_file__edges_are_those_of_the_wave():
    made = drive_file(recording(wave()), "edges")
    found = parse_drive(made.text, "drive.csv", "")
    assert made.text.startswith("# Edges of rig.tdms, sha256 abc\nrising_s,falling_s\n")
    np.testing.assert_allclose(found.first, 0.15 + 0.5 * np.arange(10), atol=2e-5)
    np.testing.assert_allclose(found.second - found.first[:-1], 0.2, atol=4e-5)
    assert made.timing.frequency_hz == pytest.approx(2.0, abs=1e-4)
    assert made.timing.duty_cycle == pytest.approx(0.4, abs=1e-3)


def test_drive_file__says_where_an_edge_may_be_missing():
    level = wave()
    level[1100:1500] = level[1100]  # low: the pulse from 1.15 s on is lost
    made = drive_file(recording(level), "edges")
    assert len(made.notes) == 1
    assert made.notes[0].startswith("the period from 0.65")
    assert "2 times the median" in made.notes[0]
    assert drive_file(recording(wave()), "edges").notes == ()


def test_drive_file__torque_is_every_sample():
    level = wave() + 0.01 * np.random.default_rng(0).standard_normal(5000)
    made = drive_file(recording(level), "torque")
    found = parse_drive(made.text, "drive.csv", "")
    assert np.array_equal(found.second, level)
    assert made.error == 0.0
    np.testing.assert_allclose(found.sections_s, 0.15 + 0.5 * np.arange(10), atol=2e-3)


@pytest.mark.parametrize("tolerance", [0.02, 0.1])
def test_drive_file__thinned_torque_stays_within_the_tolerance(tolerance):
    level = wave() + 0.01 * np.random.default_rng(0).standard_normal(5000).clip(-2, 2)
    ds = recording(level)
    made = drive_file(ds, "torque", tolerance=tolerance)
    found = parse_drive(made.text, "drive.csv", "")
    off = np.abs(np.interp(ds.time, found.first, found.second) - level).max()
    assert off == pytest.approx(made.error)
    assert made.error <= tolerance * (1 + 1e-12)
    assert made.n_rows < (2500 if tolerance == 0.02 else 400)


def test_drive_file__refuses():
    gap = recording(wave(), piece=np.repeat([0, 1], 2500))
    with pytest.raises(SpecError, match=r"has 2 pieces, and a drive has no gaps; .* --window 0 2\.499"):
        drive_file(gap, "edges")
    with pytest.raises(SpecError, match="its mapping names no drive channel"):
        drive_file(gap.drop_vars("drive"), "edges")
    with pytest.raises(SpecError, match="calls the drive a signal, not a torque; take --kind edges"):
        drive_file(recording(wave(), kind="signal"), "torque")
    with pytest.raises(SpecError, match="edges are not thinned"):
        drive_file(recording(wave()), "edges", tolerance=0.1)
    with pytest.raises(SpecError, match="must be at least 0"):
        drive_file(recording(wave()), "torque", tolerance=-1.0)
    holed = wave()
    holed[2000:2100] = np.nan
    with pytest.raises(SpecError, match="has no value at 2 s; choose a window without gaps"):
        drive_file(recording(holed), "torque")


@pytest.mark.slow
def test_cli__from_a_recording_to_a_simulation_and_a_run(main, tmp_path):
    """A virtual rig: what it measured comes back when its motor's recording drives the model."""
    (tmp_path / "rig.toml").write_text(RIG, "utf-8")
    assert main("recordings", "simulate", "rig.toml", "--out", "rec.csv")[0] == 0
    both = "recordings", "drive", "rec.csv", "--mapping", "rec.toml"
    code, out, _ = main(*both, "--kind", "torque", "--tolerance", "0.02", "--out", "torque.csv")
    assert code == 0
    assert "samples:" in out
    # two frequencies are no jitter: a window of one
    code, out, _ = main(*both, "--window", "4", "7", "--out", "edges.csv")
    assert code == 0
    words = dict(line.split(": ") for line in out.splitlines())
    assert float(words["frequency"].split()[0]) == pytest.approx(2.3, abs=1e-4)
    assert float(words["duty cycle"].split()[0]) == pytest.approx(0.55, abs=1e-3)
    assert main("simulate", "--drive", "torque.csv", "--psi1", "0.3", "--out", "a.csv", "--no-figure")[0] == 0
    found = np.genfromtxt(tmp_path / "a.csv", delimiter=",", names=True)
    measured = np.loadtxt(tmp_path / "rec.csv", delimiter=",", skiprows=2)
    ds = read_recording(tmp_path / "rec.csv", tmp_path / "rec.toml")
    assert len(ds.time) == len(measured)
    early = found["time_s"] < 3
    off = found["psi1_rad"][early] - np.interp(found["time_s"][early], ds.time, ds.psi1)
    assert np.sqrt(np.mean(off**2)) < 5e-3
    spec = 'kind = "sweep"\n[drive]\nfile = "edges.csv"\n[initial_conditions]\nkind = "random"\nn = 4\n'
    (tmp_path / "spec.toml").write_text(spec + "psi1 = [-1.0, 1.0]\n[integration]\nn_transient = 2\nn_keep = 3\n")
    assert main("run", "spec.toml", "--out", "run", "--workers", "0")[0] == 0
    assert load_drive(tmp_path / "edges.csv").n_periods >= 5
