"""Extremes and means per period: against closed forms, dense output, and themselves in other company."""

import dataclasses
from functools import partial

import numpy as np
import pytest

from magpend_core import evaluate, load_preset, run_branches, sections, trajectory
from magpend_core.engine.variational import with_tangents
from magpend_core.engine.watching import HIGHEST, LOWEST, MEAN
from magpend_core.models.duffing.system import DUFFING
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from tests.core.cells import OF_THE_MOTION, OF_THE_PENDULUM, run_cells

run_pendulum = partial(run_branches, system=PENDULUM_FITTED)

# an engine is compiled for each choice of quantities: two choices do
NAMES = ("energy", "power_in", "power_dissipated", "drive", "v")
DAMPING, STIFFNESS, AMPLITUDE, FREQUENCY = 0.2, 2.0, 0.7, 0.35


def linear_oscillator(n=3, **options):
    """Results from starts on the periodic orbit of x'' = F cos(w t) - d x' - k x, and its R and w."""
    omega = 2.0 * np.pi * FREQUENCY
    response = AMPLITUDE / (STIFFNESS - omega**2 + 1j * DAMPING * omega)
    start = [response.real, (1j * omega * response).real]
    options = {"n_transient": 1, "n_keep": 2, "rtol": 1e-9, **options}
    values = [DAMPING, STIFFNESS, 0.0, AMPLITUDE]
    found = run_cells(DUFFING, values, FREQUENCY, np.tile(start, (n, 1)), **options)
    return found, abs(response), omega


def expected_extremes(radius, omega):
    """Closed forms: energy 1/2 R^2 (w^2 sin^2 + k cos^2), both powers' means 1/2 d (R w)^2."""
    energies = 0.5 * radius**2 * np.array([omega**2, STIFFNESS])
    power = DAMPING * (radius * omega) ** 2
    # power put in: F cos(w t) v is half its mean's amplitude around the mean
    swing = 0.5 * AMPLITUDE * radius * omega
    return np.array(
        [
            [energies.min(), energies.max(), energies.mean()],
            [0.5 * power - swing, 0.5 * power + swing, 0.5 * power],
            [0.0, power, 0.5 * power],
            [-AMPLITUDE, AMPLITUDE, 0.0],
            [-radius * omega, radius * omega, 0.0],
        ]
    )


@pytest.mark.slow
def test_extremes__of_a_linear_oscillator_are_the_closed_forms():
    found, radius, omega = linear_oscillator(quantities=NAMES)
    assert found.extremes.shape == (3, 1, 2, 5, 3)
    error = abs(found.extremes - expected_extremes(radius, omega))
    # parabolas over some 100 steps per period; the largest is that of the power put in
    assert error[..., [LOWEST, HIGHEST]].max() < 1e-6
    assert error[..., MEAN].max() < 1e-8
    # halving the step takes both kinds of error down by 2^4 or more; the steps of error control
    # shrink with the fifth root of the tolerance
    tolerances = 10.0 ** np.arange(-9.0, -3.0)
    errors, steps = [], []
    for tolerance in tolerances:
        found, radius, omega = linear_oscillator(1, quantities=NAMES, rtol=tolerance, atol=tolerance)
        errors.append(np.max(abs(found.extremes[0, 0, 0] - expected_extremes(radius, omega)), axis=0))
        steps.append(found.n_steps[0, 0])
    for kind in (LOWEST, HIGHEST, MEAN):
        slope = -np.polyfit(np.log(steps), np.log([e[kind] for e in errors]), 1)[0]
        assert 3.5 < slope < 6.5, kind


@pytest.mark.slow
def test_extremes__of_the_pendulum_are_those_of_its_dense_output():
    # the attractor of period 1 at 2.2 Hz passes the magnets and both joints reverse
    preset, start = load_preset(), [0.2, 0.2, 0.0, 0.0]
    names = OF_THE_PENDULUM
    settings = {"rtol": 1e-9, "atol": 1e-9}
    found = sections(preset, 2.2, [start], n_transient=2, n_keep=2, quantities=names, **settings)
    assert found.extremes.shape == (1, 2, len(names), 3)
    for k in range(2):
        t = (np.arange(40_001) / 40_000 + 2 + k) / 2.2
        y = trajectory(preset, 2.2, start, t, **settings)
        values = evaluate(OF_THE_MOTION, t - (2 + k) / 2.2, y, preset, 2.2)
        scale = np.ptp(values, axis=0)
        mean = np.trapezoid(values, dx=1.0 / 40_000, axis=0)
        expected = np.stack([values.min(axis=0), values.max(axis=0), mean], axis=1)
        error = abs(found.extremes[0, k, -len(OF_THE_MOTION) :] - expected) / scale[:, None]
        assert error[:-1].max() < 1e-4
        assert error[-1].max() < 1e-3
        assert error[:, MEAN].max() < 1e-7


def many(n):
    rng = np.random.default_rng(3)
    starts = rng.uniform(-1.0, 1.0, (n, 4)) * [1.0, 1.0, 15.0, 15.0]
    packed = np.tile(load_preset().pack(), (n, 2, 1))
    return packed, np.tile(rng.uniform(2.0, 2.8, (n, 1)), (1, 2)), starts


def test_watching__changes_no_section_and_depends_on_no_neighbour():
    arguments, settings = many(37), {"rtol": 1e-6, "atol": 1e-6, "n_transient": 2, "n_keep": 2}
    plain = run_pendulum(*arguments, **settings)
    assert plain.extremes is None
    names = OF_THE_PENDULUM
    watched = run_pendulum(*arguments, quantities=names, **settings)
    alone = run_pendulum(*(a[5:6] for a in arguments), quantities=names, n_lanes=1, **settings)
    few = run_pendulum(*arguments, quantities=names, n_lanes=13, **settings)
    for name in (f.name for f in dataclasses.fields(plain) if f.name not in ("extremes", "return_time")):
        assert getattr(plain, name).tobytes() == getattr(watched, name).tobytes(), name
    assert np.isfinite(watched.extremes).all()
    assert watched.extremes.tobytes() == few.extremes.tobytes()
    assert watched.extremes[5:6].tobytes() == alone.extremes.tobytes()


@pytest.mark.parametrize("stop_when_closed", [False, True])
def test_extremes__belong_to_the_period_that_ends_at_their_section(stop_when_closed):
    # with damping the sections close early, after a number of periods of their own
    start = {"n_transient": 400 if stop_when_closed else 5, "stop_when_closed": stop_when_closed}
    starts = np.random.default_rng(1).uniform(-1.0, 1.0, (20, 2))
    cells, settings = (DUFFING, [0.5, 2.0, 1.0, 0.7], FREQUENCY, starts), {"rtol": 1e-6, "quantities": NAMES}
    found = run_cells(*cells, n_keep=3, **start, **settings)
    periods = int(found.n_periods.max())
    assert not stop_when_closed or periods < 400
    every = run_cells(*cells, n_keep=periods, **settings)
    for i in range(20):
        last = found.n_periods[i, 0]
        assert (found.section[i, 0] == every.section[i, 0, last - 3 : last]).all()
        assert (found.extremes[i, 0] == every.extremes[i, 0, last - 3 : last]).all()


def test_extremes__of_failed_cells_are_nan():
    packed, frequency, starts = many(3)
    starts[1] = [0.0, 0.0, 9e3, -9e3]
    options = {"n_transient": 0, "n_keep": 2, "rtol": 1e-6, "atol": 1e-6, "max_steps_per_period": 2000}
    found = run_pendulum(packed, frequency, starts, quantities=OF_THE_PENDULUM, **options)
    assert (found.status[1] > found.status[0]).all()
    assert np.isnan(found.extremes[1]).all()
    assert np.isfinite(found.extremes[[0, 2]]).all()
    # those of the system would be called with too many states
    assert with_tangents(PENDULUM_FITTED, 1).quantity_names == ()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("enrgy", "speed"), r"duffing has no 'enrgy', 'speed'; did you mean energy\? It has x, v, energy, power_in"),
        ("energy", r"one string; give a sequence of names: \['energy'\]"),
    ],
)
def test_run_branches__refuses_unknown_quantities(names, message):
    with pytest.raises(ValueError, match=message):
        linear_oscillator(quantities=names)
