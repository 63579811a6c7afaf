"""Every finding is found in a recording made to have it, and in no clean one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.rig.recordings import findings_of, recording_of
from pipeline.rig.recordings.channels import runs


def kinds(ds):
    return [(f.kind, f.channel) for f in findings_of(ds)]


def test_recording_of__clean_recordings_have_no_findings(make):
    """Turning points of a quantised swing hold their reading for a while; that is no cut-off top."""
    assert findings_of(make.recorded()) == []
    rng = np.random.default_rng(0)
    a, b = make.swing()
    for grain, noise in ((2e-3, 0.0), (2e-3, 1e-3), (0.02, 0.0), (1e-6, 1e-2)):
        a_q = np.round((a + noise * rng.standard_normal(len(a))) / grain) * grain
        b_q = np.round(b / grain) * grain
        assert findings_of(make.recorded(a_q, b_q)) == []


def test_recording_of__resting_pendulum_is_no_saturation(make):
    """A recording that ends, or begins, at rest holds one reading for long."""
    t = make.time
    decay = np.round(np.exp(-2.0 * t) * np.cos(9.0 * t) / 1e-3) * 1e-3
    held = np.where(t < 1.0, 1.0, np.round(np.cos(3.0 * (t - 1.0)) / 1e-3) * 1e-3)
    assert findings_of(make.recorded(decay, held)) == []


def test_missing__samples_that_are_no_numbers(make):
    a, _ = make.swing()
    a[100:103] = np.nan
    a[500] = np.inf
    ds = make.recorded(a)
    found = findings_of(ds)
    assert kinds(ds) == [("missing", "psi1")] * 2
    assert kinds(make.recorded(np.full_like(a, 2.5))) == [("constant", "psi1")]
    assert found[0].start_s == pytest.approx(0.2)
    assert found[0].end_s == pytest.approx(0.204)
    assert "3 samples" in found[0].text
    assert np.flatnonzero(np.isnan(ds["psi1"])).tolist() == [100, 101, 102, 500]


def test_saturated__at_the_ends_of_the_range(make):
    a, _ = make.swing()
    ds = make.recorded(np.clip(a, -0.9, 10.0), range=[-0.9, 10.0])
    found = findings_of(ds)
    assert {(f.kind, f.channel, f.severity) for f in found} == {("saturated", "psi1", "warning")}
    below = runs(a <= -0.9)
    assert [(f.start_s, f.end_s) for f in found] == [
        (pytest.approx(make.time[i]), pytest.approx(make.time[k - 1])) for i, k in below
    ]


@pytest.mark.parametrize("grain", [1e-12, 1e-3])
def test_saturated__cut_off_top_without_a_stated_range(make, grain):
    a, _ = make.swing()
    cut = np.clip(np.round(a / grain) * grain, -10.0, 0.8)
    found = findings_of(make.recorded(cut))
    assert {f.kind for f in found} == {"saturated"}
    assert len(found) == len(runs(a >= 0.8)) - (a[0] >= 0.8)
    assert "range" in found[0].text


def pot(angle, dead=0.2):
    """Voltage of a potentiometer that does not measure about half a turn, and is at 0 V there."""
    folded = np.mod(angle + math.pi, 2.0 * math.pi) - math.pi
    volts = 2.5 + 4.5 / (2.0 * math.pi - dead) * folded
    off = np.abs(folded) > math.pi - dead / 2.0
    return np.where(off, 0.0, volts), off


POT = {"unit": "V", "zero": 2.5, "range": [0.0, 5.0], "dead_band": [0.0, 0.1]}


def test_readings__zero_scale_sign_and_offset(make):
    """The value is sign x scale x (reading - zero) + offset."""
    volts = 2.5 + 0.1 * np.sin(make.time)
    ds = make.recorded(volts, unit="V", zero=2.5, scale=3.0, sign=-1, offset=0.01)
    np.testing.assert_allclose(ds["psi1"], 0.01 - 0.3 * np.sin(make.time), atol=1e-12)


def test_dead_band__is_not_measured_and_the_turns_go_on(make):
    t = make.time
    angle = 2.0 * t + np.sin(3.0 * t)  # 8 rad: over the top, again and again
    volts, off = pot(angle)
    scale = (2.0 * math.pi - 0.2) / 4.5
    ds = make.recorded(volts, **POT, scale=scale, wraps=True)
    found = findings_of(ds)
    assert {(f.kind, f.severity) for f in found} == {("dead-band", "warning"), ("wrap", "note")}
    n_crossings = len(runs(off))
    assert n_crossings >= 1
    assert sum(f.kind == "dead-band" for f in found) == n_crossings
    measured = ds["psi1"].values
    assert (np.isnan(measured) == off).all()
    np.testing.assert_allclose(measured[~off], angle[~off], atol=1e-12)


def test_wrap__that_nobody_has_stated_is_an_error_and_is_left(make):
    angle = 2.0 * make.time
    folded = np.mod(angle + math.pi, 2.0 * math.pi) - math.pi
    ds = make.recorded(folded)
    (found,) = findings_of(ds)
    assert (found.kind, found.channel, found.severity) == ("wrap", "psi1", "error")
    assert "wraps = true" in found.text
    assert found.start_s == pytest.approx(math.pi / 2.0, abs=make.step_s)
    np.testing.assert_array_equal(ds["psi1"], folded)


def test_leaps__flank_of_a_wrap_that_was_sampled(make):
    """A filter before the converter makes a ramp of the wrap: parts of a turn, none of which is one."""
    angle = 2.0 * make.time
    volts, _ = pot(angle, dead=0.0)
    smeared = np.convolve(np.pad(volts, (2, 0), mode="edge"), np.ones(3) / 3, mode="valid")
    scale = 2.0 * math.pi / 4.5
    ds = make.recorded(smeared, unit="V", zero=2.5, scale=scale, wraps=True)
    found = [f for f in findings_of(ds) if f.kind == "leap"]
    assert [(f.channel, f.severity) for f in found] == [("psi1", "error")]
    assert found[0].start_s == pytest.approx(math.pi / 2.0, abs=4 * make.step_s)
    assert "state its dead band" in found[0].text
    assert abs(float(ds["psi1"][-1]) - angle[-1]) > 6.0  # a turn is lost: that is why it is an error


def test_leaps__none_in_a_fast_and_coarsely_sampled_turn(make):
    """20 rad/s at 50 Hz, a third of a rad per sample, and 200 rad/s2."""
    t = np.arange(500) / 50.0
    angle = 20.0 * t + 2.0 * np.sin(10.0 * t)
    folded = np.mod(angle + math.pi, 2.0 * math.pi) - math.pi
    ds = make.recorded(folded, folded, wraps=True)
    assert {f.kind for f in findings_of(ds) if f.channel == "psi1"} == {"wrap"}
    np.testing.assert_allclose(ds["psi1"], angle, atol=1e-9)


def test_unwrapped__begins_anew_in_each_piece(make):
    """How often a sensor turned while nobody looked is not known."""
    angle = 2.0 * make.time
    folded = np.mod(angle + math.pi, 2.0 * math.pi) - math.pi
    halves = [make.channels({"a": folded[s], "b": folded[s]}) for s in (slice(0, 1000), slice(1000, None))]
    ds = recording_of(make.raw(*halves, apart=True), make.mapping(wraps=True))
    second = ds["psi1"].values[1000:]
    assert second[0] == folded[1000]
    np.testing.assert_allclose(np.diff(second), 2.0 * make.step_s, atol=1e-12)


def test_relative_to__is_added(make):
    a, b = make.swing()
    mapping = make.mapping(second={"relative_to": "psi1", "sign": -1})
    ds = recording_of(make.raw(make.channels({"a": a, "b": b})), mapping)
    np.testing.assert_allclose(ds["psi2"], a - b)


def test_runs__ends_where_a_piece_does():
    mask = np.array([0, 1, 1, 1, 0, 1], bool)
    piece = np.array([0, 0, 0, 1, 1, 1])
    assert runs(mask).tolist() == [[1, 4], [5, 6]]
    assert runs(mask, piece).tolist() == [[1, 3], [3, 4], [5, 6]]
    assert runs(np.zeros(3, bool)).tolist() == []
