"""Pieces of recordings: cut, driven by what was measured, and where they are by the clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from pipeline.rig.identify import build as b
from pipeline.rig.identify.judgement import judge
from pipeline.rig.identify.problem import Problem
from pipeline.rig.identify.specification import RecordingTable
from pipeline.rig.recordings import smooth
from pipeline.rig.virtual import DriveSensor, Sensor, Step, record
from pipeline.specification.problems import SpecError

NOISE = 1e-3


def table(**values):
    return RecordingTable.model_validate({"file": "", "mapping": "", **values})


def problem_of(parameters, channels, pieces, *, recorded=False) -> Problem:
    return Problem(
        model=parameters.model,
        fixed=parameters,
        free=(),
        channels=channels,
        pieces=tuple(pieces),
        noise=np.full(len(channels), NOISE),
        recorded=recorded,
    )


@pytest.fixture(scope="module")
def forced():
    """An oscillator under a sine that was measured."""
    parameters = load_model("duffing").load("hardening", amplitude=0.4)
    sensors = {"x": Sensor(noise=NOISE), "drive": DriveSensor("torque", 1e-3)}
    return parameters, record(parameters, [Step(0.2, 6)], [0.5, 0.0], 0.02 * np.arange(1400), sensors=sensors, seed=3)


CHANNELS = ("psi1", "psi2")


def switched(steps, sensor, rate_hz):
    """A pendulum under a square wave, whose switching was measured."""
    parameters = load_model("pendulum-free").load(None)
    sensors = {**dict.fromkeys(CHANNELS, Sensor(noise=NOISE)), "drive": sensor}
    times = np.arange(int(8.0 * rate_hz)) / rate_hz
    return parameters, record(parameters, steps, [0.1, 0.0, 0.0, 0.0], times, sensors=sensors, seed=4)


def test_pieces_of__a_recorded_torque_drives_the_model(forced):
    """With the true parameters, the noise is all that is left; half a sample off would leave more."""
    parameters, ds = forced
    pieces = b.pieces_of(parameters.model, ("x",), (ds, smooth(ds)), table(drive="recorded", piece_s=10.0), 0)
    assert [p.follows for p in pieces] == [-1, 0, 1]
    assert sum(len(p.time) for p in pieces) == 1400
    judged, fit = judge(problem_of(parameters, ("x",), pieces, recorded=True), {}, {}, pieces)
    assert fit.converged
    assert judged.rms["x"] == pytest.approx(NOISE, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "sensor", "rate_hz"),
    [
        # one frequency: edges between samples of 2 ms are known by the line through all of them
        ([Step(1.3, 12, {"duty_cycle": 0.45})], DriveSensor("signal", 0.02), 500.0),
        # two frequencies and duty cycles: samples lie on the torque's flanks
        ([Step(1.3, 5, {"duty_cycle": 0.45}), Step(1.5, 8, {"duty_cycle": 0.52})], DriveSensor("torque"), 2000.0),
    ],
)
def test_pieces_of__measured_edges_drive_the_model(steps, sensor, rate_hz):
    """The drive is stated nowhere but in its own channel; with it the noise is nearly all that is left."""
    parameters, ds = switched(steps, sensor, rate_hz)
    pieces = b.pieces_of(parameters.model, CHANNELS, (ds, smooth(ds)), table(drive="edges", piece_s=3.0), 0)
    # nothing is known of the drive before its first rising edge and after its last
    assert 0.7 * len(ds["time"]) < sum(len(p.time) for p in pieces) < len(ds["time"])
    judged, fit = judge(problem_of(parameters, CHANNELS, pieces), {}, {}, pieces)
    assert fit.converged
    assert max(judged.rms.values()) < 1.15 * NOISE
    late = [replace(p, drive=_later(p.drive, 0.01)) for p in pieces]
    shifted, _ = judge(problem_of(parameters, CHANNELS, late), {}, {}, late)
    assert max(shifted.rms.values()) > 2 * NOISE


def _later(drive, by_s):
    longer = drive.durations_s.copy()
    longer[-1] += by_s
    return replace(drive, durations_s=longer, start_s=drive.start_s + by_s)


def test_stretches__are_even_and_stay_within_pieces():
    time = np.concatenate([0.01 * np.arange(1000), 20 + 0.01 * np.arange(300)])
    ds = xr.Dataset(coords={"time": ("sample", time), "piece": ("sample", np.repeat([0, 1], [1000, 300]))})
    found = b.stretches(ds, 2.4, 0)
    lengths = [s.samples.stop - s.samples.start for s in found]
    assert lengths == [250] * 4 + [300]
    assert [s.continues for s in found] == [False, True, True, True, False]
    assert [s.number for s in found] == list(range(5))
    assert [s.samples.stop - s.samples.start for s in b.stretches(ds, None, 0)] == [1000, 300]


def with_remnants(ds, lengths):
    """The recording in pieces of some lengths."""
    numbers = np.repeat(np.arange(len(lengths)), lengths)
    return ds.assign_coords(piece=("sample", np.resize(numbers, ds.sizes["sample"]))).isel(sample=slice(len(numbers)))


def test_pieces_of__remnants_are_dropped_and_said(forced):
    """Pieces of 1 and 5 samples, as gaps leave them, do not stop an identification."""
    parameters, ds = forced
    ds = with_remnants(ds, [400, 1, 500, 5, 300])
    recorded = table(drive="recorded")
    pieces = b.pieces_of(parameters.model, ("x",), (ds, smooth(ds)), recorded, 0)
    assert [(p.number, len(p.time)) for p in pieces] == [(0, 400), (2, 500), (4, 300)]
    drive = b._drive_of(recorded, ds)
    cut = b._cut(ds, recorded, ("x",), drive, 0, 1)
    assert cut.dropped_sentences() == ["pieces dropped: 1, 3, with fewer than 12 usable samples (6 in all)"]
    # a remnant is held out by nobody
    (problem,) = b._hold_out_problems(0, table(hold_out=[3]), cut)
    assert "piece 3 has fewer than 12 usable samples and is dropped" in problem
    assert b._hold_out_problems(0, table(hold_out=[4]), cut) == []
    assert b._cut(ds.isel(sample=slice(400)), recorded, ("x",), drive, 0, 1).dropped_sentences() == []


def test_cut__nothing_but_remnants_is_refused_before_anything_is_smoothed(forced):
    _, ds = forced
    ds = with_remnants(ds, [3, 9, 1])
    with pytest.raises(SpecError, match=r"no piece has 12 usable samples; the longest of 3 has 9: .*resample = RATE"):
        b._cut(ds, table(), ("x",), None, 0, 1)


def test_pieces_of__starts_where_all_is_measured(forced):
    parameters, ds = forced
    holed = ds.copy(deep=True)
    holed["x"].values[:7] = np.nan
    holed["x"].values[50:60] = np.nan
    (piece,) = b.pieces_of(parameters.model, ("x",), (holed, smooth(holed)), table(), 0)
    assert len(piece.time) == 1393
    assert piece.time[0] == 0.0
    assert np.isnan(piece.measured).sum() == 10
    # the start is a smoothed state and its rate, not the raw sample
    truth = ds["x"].values[7:40]
    rate = np.polyfit(0.02 * np.arange(33), truth, 3)[-2]
    assert piece.start[1] == pytest.approx(rate, abs=0.05)


def test_noise_of__is_that_of_the_unit(forced):
    model, ds = load_model("duffing"), smooth(forced[1])
    (noise,) = b.noise_of(model, ("x",), [ds], {})
    assert noise == pytest.approx(NOISE, rel=0.1)
    assert b.noise_of(model, ("x",), [ds], {"x": 0.5}).tolist() == [0.5]


def test_channels_of__leaves_out_rates_of_measured_angles():
    model = load_model("pendulum-free")
    ds = xr.Dataset({name: ("sample", np.zeros(3)) for name in model.state_names})
    assert b.channels_of(model, (), [ds], []) == ("psi1", "psi2")
    assert b.channels_of(model, (), [ds, ds[["psi2"]]], []) == ("psi2",)
    problems = []
    assert b.channels_of(model, (), [ds[["psi1"]], ds[["psi2"]]], problems) == ()
    assert len(problems) == 1


def test_rechained__who_lost_a_predecessor_follows_none():
    from pipeline.rig.identify.problem import Piece

    pieces = [Piece(0, k, np.zeros(1), np.zeros((1, 1)), np.zeros(2), None, k - 1) for k in range(4)]
    kept = b._rechained([p for p in pieces if p.number != 1], offset=5)
    assert [p.follows for p in kept] == [-1, -1, 6]
