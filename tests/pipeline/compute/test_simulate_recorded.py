"""One trajectory under a recorded drive."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.text import Text

from magpend_core import load_preset, run_branches
from pipeline.compute.simulate import simulate
from pipeline.plots import plot_trajectory
from pipeline.specification.problems import SpecError
from pipeline.specification.recorded_drive import load_drive

HZ, START = 2.2, (0.3, -0.1, 0.0, 0.0)
DUTY = load_preset().as_dict()["duty_cycle"]


@pytest.fixture
def even(tmp_path):
    """A drive file of equal periods from 1.5 s on."""
    rising = 1.5 + np.arange(9) / HZ
    rows = [f"{a!r},{a + DUTY / HZ!r}" for a in rising.tolist()]
    path = tmp_path / "even.csv"
    path.write_text("rising_s,falling_s\n" + "\n".join(rows) + "\n", "utf-8")
    return path


@pytest.fixture
def torque(tmp_path):
    """A torque that takes other values from sample to sample, and has three rising edges."""
    times = np.linspace(0, 2, 81)
    level = np.sign(np.sin(2 * np.pi * (times - 0.1) / 0.55)) + 0.2 * np.cos(31 * times)
    rows = [f"{t!r},{x!r}" for t, x in zip(times.tolist(), level.tolist(), strict=True)]
    path = tmp_path / "torque.csv"
    path.write_text("time_s,drive\n" + "\n".join(rows) + "\n", "utf-8")
    return path


def test_simulate__equal_periods_are_the_ordinary_series(even):
    plain = simulate(HZ, START, n_transient=2, n_periods=6, samples_per_period=20)
    found = simulate(None, START, drive=even, n_transient=2, n_periods=6, samples_per_period=20)
    assert list(found.data_vars) == list(plain.data_vars)
    np.testing.assert_allclose(found.time, 1.5 + plain.time, atol=1e-12)
    for name in plain.data_vars:
        # at the flank of the drive times that differ in their last digit differ in torque
        np.testing.assert_allclose(found[name], plain[name], atol=1e-6, err_msg=name)
    np.testing.assert_allclose(found.section_times, 1.5 + np.arange(2, 9) / HZ)
    assert found.attrs["drive"] == "edges"
    assert found.attrs["frequency_hz"] == pytest.approx(HZ)


@pytest.mark.slow
def test_simulate__goes_over_the_whole_drive(even, torque):
    whole = simulate(None, START, drive=even, samples_per_period=10)
    assert whole.sizes["time"] == 81
    assert (float(whole.time[0]), float(whole.time[-1])) == (1.5, 1.5 + 8 / HZ)
    whole = simulate(None, START, drive=torque, samples_per_period=50)
    assert (float(whole.time[0]), float(whole.time[-1])) == (0.0, 2.0)


def test_simulate__part_is_of_the_whole(torque):
    drive = load_drive(torque)
    assert drive.n_periods == 4
    part = simulate(None, START, drive=torque, n_transient=2, n_periods=1, samples_per_period=40, rtol=1e-11)
    assert float(part.time[0]) == pytest.approx(drive.sections_s[1])
    assert float(part.time[-1]) == pytest.approx(drive.sections_s[2])
    whole = simulate(None, START, drive=torque, samples_per_period=2000, rtol=1e-11)
    np.testing.assert_allclose(part.psi1, np.interp(part.time, whole.time, whole.psi1), atol=1e-5)


def test_simulate__quantities_are_of_the_recorded_torque(torque):
    without_magnets = {"alpha1": 0.0, "alpha2": 0.0}
    found = simulate(None, START, drive=torque, overrides=without_magnets, samples_per_period=333)
    time, level = np.loadtxt(torque, delimiter=",", skiprows=1).T
    np.testing.assert_allclose(found.drive_torque, np.interp(found.time, time, level), atol=1e-9)
    # what the drive puts in and friction takes out is what the energy changes by
    power = (found.power_in - found.power_dissipated).values
    given = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(found.time))])
    np.testing.assert_allclose(found.energy - found.energy[0], given, atol=2e-4)


def test_simulate__section_is_that_of_a_run(even):
    found = simulate(None, START, drive=even, samples_per_period=1, rtol=1e-11, atol=1e-11)
    packed = load_preset().pack().reshape(1, 1, -1)
    options = {"n_transient": 0, "n_keep": 8, "rtol": 1e-11, "atol": 1e-11}
    expected = run_branches(packed, np.array([[HZ]]), np.array([START]), **options).section[0, 0]
    wrapped = np.angle(np.exp(1j * found.psi2.values[1:]))
    np.testing.assert_allclose(wrapped, expected[:, 1], atol=1e-7)
    np.testing.assert_allclose(found.psi1_dot[1:], expected[:, 2], atol=1e-7)


@pytest.mark.slow
def test_plot_trajectory__marks_the_sections_of_the_recording(even):
    figure = plot_trajectory(simulate(None, START, drive=even, samples_per_period=40))
    texts = [text.get_text() for text in figure.findobj(Text)]
    assert any("recorded drive" in text for text in texts)
    assert figure.data["section_times"].size == 9


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"frequency_hz": 2.0}, "frequency_hz = 2.0: the recorded drive"),
        ({"n_periods": 9}, "n_transient = 0 and n_periods = 9 are 9 drive periods, and even.csv has 8"),
        ({"n_transient": 8}, "n_transient = 8 and n_periods = 1 are 9 drive periods"),
        ({"n_periods": 0}, "n_periods = 0: must be at least 1"),
        ({"model": "duffing"}, "measured edges need a model with a parameter duty_cycle"),
    ],
)
def test_simulate__refuses(even, options, words):
    own = {"frequency_hz": None, **options}
    state = (0.3, 0.0) if "model" in options else START
    with pytest.raises(SpecError) as caught:
        simulate(initial_state=state, drive=even, **own)
    assert words in str(caught.value)
    assert len(caught.value.problems) == 1


def test_simulate__needs_a_frequency_or_a_drive():
    with pytest.raises(SpecError, match="frequency_hz = None: must be a finite number"):
        simulate(None, START)
