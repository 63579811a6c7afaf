"""Sections and quantities under a recorded drive, against ordinary runs, closed forms, another integrator."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lsim

from magpend_core import evaluate, load_preset, trajectory
from magpend_core.models import load_model
from magpend_core.pointwise import drive_level
from magpend_core.recorded_drive import evaluate_recorded, recorded_sections, recorded_trajectory
from magpend_core.sampling import Drive
from magpend_core.status import Status
from tests.core.cells import OF_THE_DRIVE, OF_THE_PENDULUM, run_cells

DUFFING = load_model("duffing")
LINEAR = DUFFING.load(damping=0.3, linear=4.0, cubic=0.0, amplitude=0.7)
PRESET = load_preset()
SYSTEM = PRESET.model.system
HZ = 2.2
TIGHT = {"rtol": 1e-11, "atol": 1e-11}


def even_drive(n, hz=HZ):
    """Periods that are all alike, with the model's own duty cycle."""
    rising = np.arange(n + 1) / hz
    return Drive.from_edges(rising, rising[:-1] + PRESET.as_dict()["duty_cycle"] / hz)


def uneven_drive(n, seed=0, jitter=0.02):
    rng = np.random.default_rng(seed)
    period = (1 + jitter * rng.standard_normal(n)) / HZ
    rising = np.concatenate([[0.0], period.cumsum()])
    return rising, rising[:-1] + period * rng.uniform(0.45, 0.55, n)


def packed(n, parameters=PRESET):
    return np.tile(parameters.pack(), (n, 1))


def states(n, rate=1.0, seed=1):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-1, 1, (n, 2)), rng.uniform(-rate, rate, (n, 2))])


@pytest.mark.slow
def test_recorded_sections__of_equal_periods_are_those_of_an_ordinary_run():
    """All numbers of cells that settle, and of some that begin by turning over."""
    start = np.vstack([states(12), states(4, rate=40.0)])
    options = {"n_transient": 8, "n_keep": 5, "quantities": OF_THE_PENDULUM, **TIGHT}
    plain = run_cells(SYSTEM, PRESET.pack(), HZ, start, **options)
    found = recorded_sections(packed(16), even_drive(13), start, system=SYSTEM, **options)
    assert np.abs(plain.turns).max() > 0
    np.testing.assert_array_equal(found.turns, plain.turns)
    np.testing.assert_allclose(found.section, plain.section, atol=1e-8)
    of_the_drive = np.s_[..., : len(OF_THE_DRIVE), :]
    np.testing.assert_allclose(found.extremes[of_the_drive], plain.extremes[of_the_drive], atol=1e-7)
    for name in ("status", "orbit_period", "n_periods"):
        np.testing.assert_array_equal(getattr(found, name), getattr(plain, name), err_msg=name)


@pytest.mark.slow
def test_recorded_sections__closes_where_an_ordinary_run_does():
    start, options = states(8), {"n_transient": 400, "n_keep": 4, "rtol": 1e-8, "atol": 1e-8}
    quiet = packed(8, load_preset(q=0.4))
    plain = run_cells(SYSTEM, quiet, HZ, start, **options)
    found = recorded_sections(quiet, even_drive(404), start, system=SYSTEM, **options)
    assert (plain.status == Status.PERIODIC).any()
    np.testing.assert_array_equal(found.status, plain.status)
    np.testing.assert_array_equal(found.orbit_period, plain.orbit_period)
    rng = np.random.default_rng(0)
    rising = np.arange(405) / HZ + 1e-5 * rng.standard_normal(405)
    drive = Drive.from_edges(rising, rising[:-1] + 0.4927 / HZ)
    quiet = packed(2, load_preset(q=0.4))
    options = {"n_transient": 400, "n_keep": 4, "system": SYSTEM}
    strict = recorded_sections(quiet, drive, states(2), **options)
    assert (strict.status == Status.BOUNDED).all()
    assert (strict.orbit_period == 0).all()
    loose = recorded_sections(quiet, drive, states(2), closure_tolerance=0.05, **options)
    assert (loose.orbit_period == 1).all()


@pytest.mark.slow
@pytest.mark.parametrize("torque", [False, True], ids=["edges", "torque"])
def test_recorded_sections__same_bits_in_any_chunks(torque):
    rising, falling = uneven_drive(9)
    drive, ends = Drive.from_edges(rising, falling), None
    if torque:
        times = np.linspace(0, 4, 41)
        drive, ends = (Drive.from_torque(times, np.sin(13 * times)), np.array([3, 7, 12, 15, 21, 28, 30, 35, 39]))
    cells, options = (packed(5), drive, states(5, rate=30.0)), {"ends": ends, "n_transient": 4, "n_keep": 5}
    found = [
        recorded_sections(*cells, system=SYSTEM, n_points=n, n_lanes=lanes, **options)
        for n, lanes in ((None, 64), (1, 3), (4, 8))
    ]
    for other in found[1:]:
        for name in ("section", "turns", "status", "n_steps", "n_rejected", "n_periods", "final_state", "step_size"):
            np.testing.assert_array_equal(getattr(other, name), getattr(found[0], name), err_msg=name)


@pytest.mark.slow
def test_recorded_sections__of_uneven_periods_against_another_integrator(pendulum_rhs):
    """Periods and duty cycles that differ, the model's own wave written out from Eq. 8."""
    model = load_model("pendulum-free")
    values = model.load(mu=0.0, eps=40.0, eps_drive=30.0)
    p, start = values.as_dict(), [0.4, -0.3, 1.0, -2.0]
    rising, falling = uneven_drive(6, jitter=0.08)

    def torque(t):
        k = min(int(np.searchsorted(rising, t, side="right")) - 1, 5)
        length = rising[k + 1] - rising[k]
        phase = np.pi / 2 - np.pi * (falling[k] - rising[k]) / length
        wave = np.sin(2 * np.pi * (t - rising[k]) / length + phase) - np.sin(phase)
        return p["q"] * 2 / np.pi * np.arctan(p["eps_drive"] * wave)

    drive, options = Drive.from_edges(rising, falling), {"n_transient": 2, "n_keep": 4, **TIGHT}
    found = recorded_sections(values.pack()[None], drive, [start], system=model.system, **options)
    other = solve_ivp(
        pendulum_rhs(p, torque), (0, rising[-1]), start, "DOP853", rising[3:], rtol=1e-10, atol=1e-10, max_step=2e-3
    )
    np.testing.assert_allclose(found.section[0, 0], other.y.T, atol=2e-6)
    assert found.n_periods[0, 0] == 6


@pytest.mark.slow
def test_recorded_sections__of_a_torque_are_the_exact_response():
    """A linear oscillator, values joined by lines, sections at some of the samples."""
    times = np.linspace(0, 6, 241)
    torque = np.random.default_rng(2).normal(size=241).cumsum() * 0.1
    ends = np.array([9, 40, 41, 100, 180, 239])
    drive, options = Drive.from_torque(times, torque), {"ends": ends, "n_transient": 1, "n_keep": 5, **TIGHT}
    found = recorded_sections(LINEAR.pack()[None], drive, [[0.1, 0.0]], system=DUFFING.system, **options)
    exact = lsim(([[0, 1], [-4.0, -0.3]], [[0], [1]], np.eye(2), [[0], [0]]), torque, times, [0.1, 0.0])[1]
    np.testing.assert_allclose(found.section[0, 0], exact[ends[1:] + 1], atol=1e-9)


@pytest.mark.slow
def test_recorded_trajectory__of_the_models_own_torque_converges_to_the_ordinary_one():
    """Lines between samples of the drive: the error falls with the square of their distance."""
    parameters = DUFFING.load(damping=0.3, linear=-1.0, cubic=1.0, amplitude=5.0)
    start, times = np.array([0.3, -0.1]), np.linspace(0, 3 / HZ, 31)
    exact = trajectory(parameters, HZ, start, times, **TIGHT)
    errors = []
    for n in (150, 300, 600):
        samples = np.linspace(0, 3 / HZ, n + 1)
        drive = Drive.from_torque(samples, drive_level(samples, parameters, HZ))
        found = recorded_trajectory(parameters, drive, start, times, **TIGHT)
        errors.append(np.abs(found - exact).max())
    assert errors[-1] < 1e-4
    # second order: a fourth for each halving
    assert errors[0] / errors[2] > 8


def test_recorded_sections__says_who_diverged():
    runaway = DUFFING.load(damping=0.0, linear=-1.0, cubic=-1.0, amplitude=0.0).pack()
    drive = Drive.from_torque(np.linspace(0, 20, 81), np.zeros(81))
    both, starts = np.array([runaway, LINEAR.pack()]), [[2.0, 1.0], [0.1, 0.0]]
    options = {"n_transient": 3, "n_keep": 60, "n_points": 7}
    found = recorded_sections(both, drive, starts, system=DUFFING.system, **options)
    assert found.status[:, 0].tolist() == [Status.DIVERGED, Status.BOUNDED]
    assert np.isnan(found.section[0]).all()
    assert np.isfinite(found.section[1]).all()
    assert found.n_periods[0, 0] < 63 == found.n_periods[1, 0]
    options = {"n_transient": 0, "n_keep": 2, "max_steps_per_period": 5}
    found = recorded_sections(packed(1), even_drive(3), states(1), system=SYSTEM, **options)
    assert found.status[0, 0] == Status.STEP_LIMIT


def test_recorded_sections__refuses_what_the_drive_has_not():
    options = {"n_transient": 3, "n_keep": 2, "system": SYSTEM}
    with pytest.raises(ValueError, match=r"5 sections are asked for, and the drive has 4"):
        recorded_sections(packed(1), even_drive(4), states(1), **options)
    with pytest.raises(ValueError, match="ends must rise"):
        recorded_sections(packed(1), even_drive(9), states(1), ends=np.array([0, 2, 1, 3, 4]), **options)
    options |= {"ends": np.arange(0, 9, 2)[:5], "quantities": ["psi1"]}
    with pytest.raises(ValueError, match="extremes are taken over intervals"):
        recorded_sections(packed(1), even_drive(9), states(1), **options)


def test_evaluate_recorded__of_edges_is_each_periods_own():
    rising, falling = uneven_drive(4)
    drive, start = Drive.from_edges(rising, falling), states(1)[0]
    times = np.linspace(0, rising[-1], 97)
    series = recorded_trajectory(PRESET, drive, start, times)
    names = ["drive_torque", "power_in", "energy"]
    found = evaluate_recorded(names, times, series, PRESET, drive)
    for k in range(4):
        inside = (times >= rising[k]) & (times < rising[k + 1])
        duty = (falling[k] - rising[k]) / (rising[k + 1] - rising[k])
        own = PRESET.replace(duty_cycle=duty)
        hz = 1 / (rising[k + 1] - rising[k])
        expected = evaluate(names, times[inside] - rising[k], series[inside], own, hz)
        np.testing.assert_allclose(found[inside], expected, atol=1e-9)


@pytest.mark.slow
def test_evaluate_recorded__of_a_torque_is_the_torque():
    times = np.linspace(0, 2, 21)
    torque = np.random.default_rng(3).normal(size=21)
    drive, at = Drive.from_torque(times, torque), np.linspace(0, 2, 333)
    series = recorded_trajectory(LINEAR, drive, states(1)[0, :2], at)
    found = evaluate_recorded(["drive", "power_in"], at, series, LINEAR, drive)
    np.testing.assert_allclose(found[:, 0], np.interp(at, times, torque), atol=1e-9)
    np.testing.assert_allclose(found[:, 1], found[:, 0] * series[:, 1], atol=1e-9)
