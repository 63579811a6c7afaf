"""Recordings whose drive was not measured, but has a known frequency; data by another integrator."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from magpend_core.models import load_model
from pipeline.rig.identify import identification
from pipeline.rig.identify import validation as checking
from pipeline.rig.identify.build import drive_problems
from pipeline.rig.identify.specification import RecordingTable
from pipeline.specification.problems import SpecError

TRUTH = {"damping": 0.15, "linear": 1.1, "cubic": 0.4, "amplitude": 0.5}
FREQUENCIES, PHASES, NOISE = (0.21, 0.16), (0.83, 0.37), 0.01
STRETCH_S, GAP_S = 30.0, 7.3

SPEC = """
kind = "identification"
model = "duffing"
preset = "hardening"
[identify.damping]
bounds = [0.0, 1.0]
[identify.linear]
[identify.cubic]
[identify.amplitude]
start = 0.4
bounds = [0.01, 5.0]
[[recordings]]
file = "a.csv"
mapping = "a.toml"
drive = "known"
frequency_hz = 0.21
piece_s = 15.0
hold_out = [2]
[[recordings]]
file = "b.csv"
mapping = "a.toml"
drive = "known"
frequency_hz = 0.16
piece_s = 15.0
[search]
n_starts = 2
n_samples = 16
profiles = false
"""
MAPPING = """
model = "duffing"
time = { channel = "time" }
[channels.x]
channel = "x"
unit = "m"
"""


def write_driven(path, frequency_hz, phase, seed):
    """Write two stretches of one motion, with a gap in which it was not recorded."""

    def oscillator(t, y):
        force = TRUTH["amplitude"] * np.cos(2 * np.pi * (frequency_hz * t + phase))
        return y[1], force - TRUTH["damping"] * y[1] - TRUTH["linear"] * y[0] - TRUTH["cubic"] * y[0] ** 3

    t = 0.1 * np.arange(round(STRETCH_S / 0.1))
    t = np.concatenate([t, t + STRETCH_S + GAP_S])
    found = solve_ivp(oscillator, (0.0, t[-1]), [0.8, -0.3], method="DOP853", t_eval=t, rtol=1e-10, atol=1e-10)
    x = found.y[0] + NOISE * np.random.default_rng(seed).normal(size=len(t))
    path.write_text("\n".join(["time,x", *(f"{a:.3f},{b:.8f}" for a, b in zip(t, x, strict=True))]) + "\n")


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder = tmp_path_factory.mktemp("known")
    for name, frequency, phase, seed in zip("ab", FREQUENCIES, PHASES, (1, 2), strict=True):
        write_driven(folder / f"{name}.csv", frequency, phase, seed)
    (folder / "a.toml").write_text(MAPPING)
    return folder


def identify(folder, out, *changes, figures=False):
    text = SPEC
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "spec.toml").write_text(text)
    return identification.identify(folder / "spec.toml", out, figures=figures, echo=lambda _: None)


@pytest.mark.slow
def test_known_drive__parameters_and_phases_are_found(rig, tmp_path):
    result = identify(rig, tmp_path / "out", figures=True)
    truth = {**TRUTH, "phase.0": PHASES[0], "phase.1": PHASES[1]}
    assert set(result["estimates"]) == set(truth)
    for name, value in truth.items():
        about = result["estimates"][name]
        assert abs(about["value"] - value) < 3.5 * about["error"], name
        assert about["error"] < 0.1 * value, name
    assert result["held_out"]["rms"]["x"] == pytest.approx(NOISE, rel=0.15)
    for about, frequency in zip(result["drive_frequencies"], FREQUENCIES, strict=True):
        assert abs(about["estimate_hz"] - frequency) < 3.5 * about["error_hz"]
        assert about["error_hz"] < 1e-3
        assert about["verdict"] == "agrees"
    assert result["warnings"] == []
    with pytest.raises(SpecError, match="the phase of its drive was fitted"):
        checking.check(tmp_path / "out", rig / "a.csv")


@pytest.mark.slow
def test_known_drive__a_given_phase_is_held(rig, tmp_path):
    text = [
        (f"frequency_hz = {f}", f"frequency_hz = {f}\nphase = {p}") for f, p in zip(FREQUENCIES, PHASES, strict=True)
    ]
    result = identify(rig, tmp_path / "out", *text)
    assert set(result["estimates"]) == set(TRUTH)
    assert result["rms"]["x"] == pytest.approx(NOISE, rel=0.1)
    assert checking.check(tmp_path / "out", rig / "a.csv")["rms"]["x"] == pytest.approx(NOISE, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stated", "verdict"),
    [(0.2115, "off"), (0.22, "not decided")],  # a tenth of a period over the recording, two thirds of one
)
def test_known_drive__a_wrong_frequency_is_noticed(rig, tmp_path, stated, verdict):
    result = identify(
        rig, tmp_path / "out", ("frequency_hz = 0.21", f"frequency_hz = {stated}"), ("n_starts = 2", "n_starts = 1")
    )
    about, other = result["drive_frequencies"]
    assert about["verdict"] == verdict
    assert any(w.startswith(f"recordings[0].frequency_hz = {stated}") for w in result["warnings"])
    if verdict == "off":
        assert about["estimate_hz"] == pytest.approx(FREQUENCIES[0], abs=3e-4)
        assert other["verdict"] == "agrees"


def test_known_drive__a_model_without_a_drive_is_refused():
    model = load_model("lorenz")
    table = RecordingTable.model_validate({"file": "", "mapping": "", "drive": "known", "frequency_hz": 0.2})
    (problem,) = drive_problems(model, [table], [xr.Dataset(coords={"time": 0.1 * np.arange(20)})], "recordings")
    assert problem.startswith('recordings[0].drive = "known": lorenz has no drive')


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("frequency_hz = 0.16\n", "", "recordings[1].frequency_hz: missing"),
        ("frequency_hz = 0.16", "frequency_hz = 7.0", "recordings[1].frequency_hz = 7: must be below 5 Hz"),
        (
            'drive = "known"\nfrequency_hz = 0.16',
            "frequency_hz = 0.16",
            "recordings[1].frequency_hz = 0.16: belongs to",
        ),
        ('drive = "known"\nfrequency_hz = 0.16', "", 'recordings[1]: beside drive = "known" of others'),
        ('drive = "known"\nfrequency_hz = 0.16', 'drive = "recorded"', 'drive = "known" cannot stand beside'),
        ("hold_out = [2]", "hold_out = [0, 1, 2, 3]", "recordings[0].phase: missing"),
        ("[search]", '[fit]\nslopes = "variational"\n[search]', "fit.slopes"),
    ],
)
def test_known_drive__bad_input_is_refused(rig, tmp_path, old, new, words):
    with pytest.raises(SpecError) as caught:
        identify(rig, tmp_path / "out", (old, new))
    assert any(words in problem for problem in caught.value.problems), caught.value.problems
