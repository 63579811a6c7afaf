"""Slow sweeps, other models, single series: measured diagrams beyond steps of the pendulum."""

from __future__ import annotations

import json

import numpy as np
import pytest

from magpend_core.models import load_model
from pipeline.rig.measured.declaration import SweepOptions
from pipeline.rig.measured.diagram import measure
from pipeline.rig.measured.sections import section_phase
from pipeline.rig.measured.series import series_of
from pipeline.rig.virtual import DriveSensor, Sensor, Step, record
from pipeline.specification.problems import SpecError

from .conftest import RIGHT, walked


@pytest.mark.slow
def test_measure__a_slow_sweep_is_cut_into_windows(pendulum, record_steps):
    """From 2.46 to 2.56 Hz, 0.2 mHz a period: the right motion's doubling, where it is without noise."""
    frequencies = np.arange(2.46, 2.56, 2e-4)
    ds, truth = record_steps(pendulum, [(f, 1) for f in frequencies], RIGHT)
    found = measure([ds], parameters=pendulum)
    assert found.sizes["step"] == len(frequencies) // 40
    middles = frequencies[: found.sizes["step"] * 40].reshape(-1, 40).mean(axis=1)
    # the recording begins within the first period
    np.testing.assert_allclose(found["frequency"].values, middles, atol=3e-4)
    assert set(found["direction"].values) == {"up"}
    assert set(found["side"].values.tolist()) == {2}
    sure = found["confidence"].values > 0.8
    periods, f = found["orbit_period"].values[sure], found["frequency"].values[sure]
    assert periods[0] == 2
    assert periods[-1] == 1
    edge = 0.5 * (f[periods == 2].max() + f[periods == 1].min())
    # the sweep drags the doubling along, from 2.5 Hz where it is infinitely slow; a window is 8 mHz wide
    split = np.abs(np.diff([t[0, 0] for t in truth]))
    ended = frequencies[np.flatnonzero(split > 1e-3)[-1]]
    assert edge == pytest.approx(ended, abs=0.008)


@pytest.mark.slow
def test_measure__a_drive_that_truly_jitters_hides_no_period(pendulum, record_steps):
    """Half a millisecond shakes the motion by five times the sections' noise: the same periods."""
    rng, steps = np.random.default_rng(3), []
    for f in (2.46, 2.48, 2.54, 2.56):
        edges = np.arange(151) / f + rng.normal(0, 5e-4, 151)
        steps += [(1 / d, 1) for d in np.diff(edges)]
    found = measure(
        [record_steps(pendulum, steps, RIGHT)[0]], SweepOptions(transient=80, window=0), parameters=pendulum
    )
    np.testing.assert_allclose(found["frequency"].values, [2.46, 2.48, 2.54, 2.56], atol=3e-4)
    # the edges' own scatter and that of sampling
    np.testing.assert_allclose(found["jitter_s"].values, np.hypot(5e-4, 1e-3 / np.sqrt(12)), rtol=0.2)
    assert found["orbit_period"].values.tolist() == [2, 2, 1, 1]
    assert np.median(found["confidence"].values) > 0.8
    assert (found["confidence"].values > 0.5).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "phase"), [("pendulum", 0.0), ("pendulum-sine", 0.0), ("duffing", 0.25), ("double-pendulum", 0.0)]
)
def test_section_phase__is_what_the_model_says(model, phase):
    """The rising edge, the rising zero, the maximum; and a drive that does nothing."""
    assert section_phase(load_model(model).load(), 1.3) == pytest.approx(phase, abs=1e-4)


def test_measure__sections_of_another_model_are_where_it_takes_them():
    """A hardening Duffing oscillator driven by a cosine: sections at its maximum, against the engine's."""
    parameters = load_model("duffing").load("hardening")
    steps = [Step(f, 70) for f in (0.16, 0.18, 0.2)]
    times = np.arange(0.0, sum(s.duration_s for s in steps) - 0.02, 0.02)
    sensors = {"x": Sensor(noise=1e-3), "drive": DriveSensor("torque", 1e-3)}
    ds = record(parameters, steps, [0.1, 0.0], times, sensors=sensors, seed=3)
    found = measure([ds], SweepOptions(transient=45, window_s=0.8), parameters=parameters)
    assert "side" not in found
    np.testing.assert_allclose(found["frequency"].values, [0.16, 0.18, 0.2], rtol=1e-4)
    assert found["orbit_period"].values.tolist() == [1, 1, 1]
    f = np.array([0.16, 0.18, 0.2])
    exact = walked(parameters, f, [0.1, 0.0], n_transient=65, n_keep=1).section[0, :, 0]
    mean = np.nanmean(found["section"].values, axis=1)
    # a mean of 20 sections, and what is left of the transient
    np.testing.assert_allclose(mean, exact, atol=6e-3)


@pytest.mark.slow
def test_series_of__the_model_follows_the_rig_from_the_same_state(pendulum, swept):
    ds = series_of(swept[0][0], pendulum, start_s=30.0, n_periods=5)
    assert float(ds.attrs["frequency_hz"]) == pytest.approx(2.46, abs=5e-5)
    assert ds["time"].values[-1] == pytest.approx(5 / 2.46, abs=2e-3)
    rms = json.loads(ds.attrs["rms"])
    # the start is known to 0.25 mrad and 50 mrad/s; over 80 ms the latter is 4 mrad, and motions part slowly
    assert rms["psi1"] < 0.015
    assert rms["psi2"] < 0.015
    assert rms["psi1_dot"] < 0.2


@pytest.mark.slow
def test_series_of__another_parameter_is_seen(pendulum, swept):
    """With 10 % more drive the model leaves the rig's motion."""
    off = series_of(swept[0][0], pendulum.replace(q=1.1 * pendulum["q"]), start_s=30.0, n_periods=5)
    own = series_of(swept[0][0], pendulum, start_s=30.0, n_periods=5)
    ratio = json.loads(off.attrs["rms"])["psi1"] / json.loads(own.attrs["rms"])["psi1"]
    assert ratio > 3


def test_series_of__ends_where_the_frequency_changes(pendulum, swept):
    """The first step ends after 110 periods; 200 are asked for from the 100th on."""
    ds = series_of(swept[0][0], pendulum, start_s=99.5 / 2.46, n_periods=200)
    assert ds["time"].values[-1] == pytest.approx(10 / 2.46, abs=0.5 / 2.46)


@pytest.mark.slow
def test_series_of__what_does_not_fit_is_refused(pendulum, swept):
    recording = swept[0][0]
    with pytest.raises(SpecError, match="mapped to the model pendulum, while duffing"):
        series_of(recording, load_model("duffing").load())
    with pytest.raises(SpecError, match="psi2, psi2_dot at the start is not known"):
        series_of(recording.drop_vars("psi2"), pendulum)
    with pytest.raises(SpecError, match="start_s = 1e\\+06"):
        series_of(recording, pendulum, start_s=1e6)
    with pytest.raises(SpecError, match="periods = 0"):
        series_of(recording, pendulum, n_periods=0)
