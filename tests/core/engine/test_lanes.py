"""The engine: its tableau, order, steps and statuses."""

import itertools
from functools import partial

import numpy as np
import pytest
from numba import njit

from magpend_core import Status, load_preset, run_branches, sections, trajectory
from magpend_core.engine.jit import OPTIONS
from magpend_core.engine.lanes import engine_bindings, rows_of
from magpend_core.engine.observers import RECORD
from magpend_core.engine.simd import WIDTH, store
from magpend_core.engine.tableau import DENSE, ERROR, N_STAGES, NODES, STAGES
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from tests.core.cells import scipy_end

run_pendulum = partial(run_branches, system=PENDULUM_FITTED)

# row 6 of the tableau holds the weights of the solution of order 5
WEIGHTS = np.append(STAGES[6], 0.0)
MATRIX = np.hstack([STAGES, np.zeros((N_STAGES, 1))])
EMBEDDED = WEIGHTS - ERROR


def order_conditions(weights, order):
    """Yield the defects of the conditions of each rooted tree with `order` nodes (Butcher)."""
    a, c, b = MATRIX, NODES, weights
    trees = {
        1: [(b.sum(), 1)],
        2: [(b @ c, 2)],
        3: [(b @ c**2, 3), (b @ a @ c, 6)],
        4: [(b @ c**3, 4), (b @ (c * (a @ c)), 8), (b @ a @ c**2, 12), (b @ a @ a @ c, 24)],
        5: [
            (b @ c**4, 5),
            (b @ (c**2 * (a @ c)), 10),
            (b @ (c * (a @ c**2)), 15),
            (b @ (c * (a @ a @ c)), 30),
            (b @ (a @ c) ** 2, 20),
            (b @ a @ c**3, 20),
            (b @ a @ (c * (a @ c)), 40),
            (b @ a @ a @ c**2, 60),
            (b @ a @ a @ a @ c, 120),
        ],
    }
    return [value - 1.0 / size for value, size in trees[order]]


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5])
def test_tableau__order_conditions(order):
    assert np.max(np.abs(order_conditions(WEIGHTS, order))) < 1e-15
    embedded = np.max(np.abs(order_conditions(EMBEDDED, order)))
    assert embedded < 1e-15 if order < 5 else embedded > 1e-4


def test_tableau__rows_sum_to_the_nodes():
    assert MATRIX.sum(axis=1) == pytest.approx(NODES, abs=4e-16 * 16)
    assert abs(ERROR.sum()) < 1e-16
    # the last stage is the next step's first
    assert NODES[5] == NODES[6] == 1.0
    assert (MATRIX[6, :6] == WEIGHTS[:6]).all()


def test_dense__ends_at_the_step_and_has_order_4():
    x = np.linspace(0.0, 1.0, 11)
    # b_i(x), one row per stage
    b = DENSE @ np.array([x, x**2, x**3, x**4])
    assert b[:, -1] == pytest.approx(WEIGHTS, abs=1e-14)
    assert b[:, 0] == pytest.approx(np.zeros(N_STAGES), abs=0.0)
    # slopes at both ends: a continuously differentiable solution
    assert DENSE[:, 0].tolist() == [1.0] + [0.0] * 6
    assert pytest.approx([0.0] * 6 + [1.0], abs=1e-13) == DENSE @ [1.0, 2.0, 3.0, 4.0]
    a, c = MATRIX, NODES
    for tree, size, order in [
        (np.ones(N_STAGES), 1, 1),
        (c, 2, 2),
        (c**2, 3, 3),
        (a @ c, 6, 3),
        (c**3, 4, 4),
        (c * (a @ c), 8, 4),
        (a @ c**2, 12, 4),
        (a @ a @ c, 24, 4),
    ]:
        assert tree @ b == pytest.approx(x**order / size, abs=1e-13)


@pytest.fixture(scope="module")
def stepper(oscillator):
    """Integrate the oscillator from t = 0 with steps of fixed size; the engine's own stages."""
    bindings = engine_bindings(oscillator, RECORD)
    run_stage, finish_step = bindings["run_stage"], bindings["finish_step"]
    squared_error = bindings["squared_error"]
    rows = rows_of(oscillator)

    @njit(**OPTIONS)
    def run(w, h, n_steps, norms):
        for i in range(n_steps + 1):
            for lane in range(WIDTH):
                # the first attempt has size 0 and fills the first slope
                w[rows.step + lane] = h if i > 0 else 0.0
            for s in range(1, N_STAGES):
                run_stage(w, 0, s)
            store(norms, 0, squared_error(w, 0, 0.0, 1.0))
            finish_step(w, 0, 1.0, 1e9, 1e9)

    def integrate(parameters, frequency, state, h, n_steps):
        w = np.zeros(rows.size)
        constants = np.zeros(oscillator.n_constants)
        oscillator.constants(frequency, np.array(parameters), constants)
        full = [*state, 1.0, 0.0, 0.0, 1.0]
        for i, value in enumerate(full):
            w[rows.state + i * WIDTH : rows.state + (i + 1) * WIDTH] = value
        for i, value in enumerate(constants):
            w[rows.constants + i * WIDTH : rows.constants + (i + 1) * WIDTH] = value
        w[rows.target : rows.target + WIDTH] = np.inf
        w[rows.period : rows.period + WIDTH] = 1.0
        norms = np.zeros(WIDTH)
        run(w, h, n_steps, norms)
        assert w[rows.rejected] == 0.0
        assert w[rows.time] == pytest.approx(h * n_steps)
        return w[rows.state : rows.state + 6 * WIDTH : WIDTH].copy(), np.sqrt(norms[0])

    return integrate


DUFFING = [0.15, -1.0, 1.0, 0.2]


def duffing_exactly(time, frequency, state):
    d, k, k3, f = DUFFING

    def rhs(t, y):
        x, v, a, b, da, db = y
        s = k + 3.0 * k3 * x * x
        force = f * np.cos(2 * np.pi * frequency * t)
        return v, force - d * v - k * x - k3 * x**3, da, db, -d * da - s * a, -d * db - s * b

    return scipy_end(rhs, [*state, 1, 0, 0, 1], time, 1e-13)


@pytest.mark.slow
def test_engine__converges_with_order_5_and_so_does_its_estimate(stepper):
    frequency, state, time = 0.5 / np.pi, [0.5, 0.3], 3.0
    exact = duffing_exactly(time, frequency, state)
    n = np.array([24, 32, 48, 64, 96])
    errors = [np.max(abs(stepper(DUFFING, frequency, state, time / k, k)[0] - exact)) for k in n]
    slope = np.polyfit(np.log(n), np.log(errors), 1)[0]
    assert -slope == pytest.approx(5.0, abs=0.2)
    # of a step h: the embedded solution of order 4 leaves h^5
    frequency, state = 0.5 / np.pi, [0.5, 0.3]
    h = np.array([0.2, 0.1, 0.05, 0.025])
    norms = [stepper(DUFFING, frequency, state, step, 1)[1] for step in h]
    slope = np.polyfit(np.log(h), np.log(norms), 1)[0]
    assert slope == pytest.approx(5.0, abs=0.2)


def test_engine__error_follows_the_tolerance(preset, reference):
    orbit = reference("trajectories")[2]
    exact = np.array(orbit["sections"][1])
    errors = []
    for rtol in (1e-5, 1e-7, 1e-9, 1e-11):
        found = sections(preset, orbit["frequency_hz"], [orbit["y0"]], n_transient=1, n_keep=1, rtol=rtol, atol=rtol)
        errors.append(np.max(abs(found.section[0, 0] - exact)))
        assert errors[-1] < 300.0 * rtol
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize("rtol", [1e-5, 1e-8, 1e-11])
def test_engine__few_attempts_are_rejected(preset, rtol):
    # a textbook controller, which does not see the layers coming, rejects a third
    frequencies = np.linspace(2.0, 2.9, 32)
    starts = np.full((32, 4), 0.1)
    found = sections(preset, frequencies, starts, n_transient=9, n_keep=1, rtol=rtol, atol=rtol)
    assert found.n_rejected.sum() < 0.1 * found.n_steps.sum()
    assert found.n_periods.tolist() == [10] * 32


@pytest.mark.parametrize("eps_drive", [1e3, 1e6])
def test_engine__steps_end_at_the_drives_edges(preset, eps_drive):
    # edges of a microsecond; at a wrong instant each would cost a dozen rejections
    sharp = preset.replace(eps_drive=eps_drive)
    found = sections(sharp, 2.2, [[0.1, 0.2, 0.0, 0.0]], n_transient=0, n_keep=20, rtol=1e-6, atol=1e-6)
    assert found.n_rejected[0] < 0.06 * found.n_steps[0]
    assert found.n_steps[0] < 20 * 200


def test_run_branches__rotating_orbits_count_their_turns(preset):
    # 60 and -40 rad/s: some dozens of turns in three periods
    starts = np.array([[0.2, 0.2, 60.0, -40.0], [3.0, -3.0, -50.0, 70.0]])
    found = sections(preset, 2.0, starts, n_transient=0, n_keep=4, rtol=1e-9, atol=1e-9)
    assert np.max(abs(found.section[:, :, :2])) <= np.pi
    for k, start in enumerate(starts):
        y = trajectory(preset, 2.0, start, np.arange(1, 5) / 2.0, rtol=1e-9, atol=1e-9)
        unwrapped = y[-1, :2] - y[0, :2]
        assert abs(unwrapped).min() > 20.0
        between = found.section[k, -1, :2] - found.section[k, 0, :2] + 2.0 * np.pi * found.turns[k]
        assert between == pytest.approx(unwrapped, abs=1e-6)
        assert y[:, 2:] == pytest.approx(found.section[k, :, 2:], abs=1e-6)
    # far from the bottom and at rest: sections next to the cut, on both sides of it
    still = load_preset(g=0.0, q=0.0, alpha1=0.0, alpha2=0.0)
    angles = np.array([np.pi, -np.pi, np.nextafter(np.pi, 4.0), 3.0 * np.pi, -3.0 * np.pi, 7.0])
    starts = np.stack([angles, angles, 0.0 * angles, 0.0 * angles], axis=1)
    result = sections(still, 1.0, starts, n_transient=0, n_keep=1)
    found = result.section[:, 0, :2]
    assert ((found > -np.pi) & (found <= np.pi)).all()
    assert np.exp(1j * found) == pytest.approx(np.exp(1j * starts[:, :2]), abs=1e-12)
    assert found[0].tolist() == [np.pi, np.pi]
    assert (result.final_state[:, :2] == found).all()


@pytest.mark.slow
def test_run_branches__diverged_cells_and_what_follows_them(oscillator):
    # x'' = 9 x grows by e^3 a period: the first passes the bound of 1000 in its second period, the
    # derivatives of the second their bound of 1e6 in its fifth
    starts = np.array([[1.0, 3.0, 1.0, 0.0, 0.0, 1.0], [1e-9, 3e-9, 1.0, 0.0, 0.0, 1.0]])
    packed, settings = np.tile([0.0, -9.0, 0.0, 0.0], (2, 3, 1)), {"rtol": 1e-8, "atol": 1e-8}
    found = run_branches(packed, np.ones((2, 3)), starts, system=oscillator, n_transient=0, n_keep=3, **settings)
    assert found.status.tolist() == [
        [Status.DIVERGED, Status.UNREACHED, Status.UNREACHED],
        [Status.BOUNDED, Status.DIVERGED, Status.UNREACHED],
    ]
    assert found.n_periods.tolist() == [[2, 0, 0], [3, 2, 0]]
    assert np.isfinite(found.section[1, 0]).all()
    # no section of a failed cell is left, though some had been kept
    assert np.isnan(found.section[0]).all()
    assert np.isnan(found.section[1, 1:]).all()
    assert (found.orbit_period == 0).all()


def test_run_branches__step_limit(preset):
    packed = np.tile(preset.pack(), (1, 2, 1))
    settings = {"n_transient": 0, "n_keep": 2, "rtol": 1e-8, "atol": 1e-8}
    start = [[0.2, 0.2, 0.0, 0.0]]
    found = run_pendulum(packed, [[2.2, 2.2]], start, max_steps_per_period=20, **settings)
    assert found.status.tolist() == [[Status.STEP_LIMIT, Status.UNREACHED]]
    assert np.isnan(found.section).all()
    assert found.n_periods.tolist() == [[0, 0]]
    assert found.n_steps[0, 0] + found.n_rejected[0, 0] == 21
    # the limit is on each period, not on their sum
    free = run_pendulum(packed, [[2.2, 2.2]], start, **settings)
    most = int(np.max(free.n_steps + free.n_rejected))
    found = run_pendulum(packed, [[2.2, 2.2]], start, max_steps_per_period=most - 20, **settings)
    assert (found.status < Status.DIVERGED).all()


def test_run_branches__counts_periods_and_keeps_the_last(preset):
    start = [[0.2, 0.2, 0.0, 0.0]]
    for n_transient, n_keep in itertools.product((0, 3), (1, 4)):
        found = sections(preset, 2.2, start, n_transient=n_transient, n_keep=n_keep)
        every = sections(preset, 2.2, start, n_transient=0, n_keep=n_transient + n_keep)
        assert found.n_periods[0] == n_transient + n_keep
        assert (found.section[0] == every.section[0, n_transient:]).all()
    nothing = np.zeros((0, 2, 34)), np.zeros((0, 2)), np.zeros((0, 4))
    found = run_pendulum(*nothing, n_transient=1, n_keep=3, rtol=1e-6, atol=1e-6)
    assert found.section.shape == (0, 2, 3, 4)
    assert found.status.shape == (0, 2)
