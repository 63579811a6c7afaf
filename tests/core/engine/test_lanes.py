"""The engine: its tableau, order, steps and statuses."""

import dataclasses
import itertools

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp

from magpend_core import Status, load_preset, run_branches, sections, trajectory
from magpend_core.engine.jit import OPTIONS, inline
from magpend_core.engine.lanes import FADED, engine_bindings, rows_of
from magpend_core.engine.observers import RECORD
from magpend_core.engine.simd import WIDTH, store
from magpend_core.engine.tableau import DENSE, ERROR, N_STAGES, NODES, STAGES

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

    return solve_ivp(rhs, (0.0, time), [*state, 1, 0, 0, 1], "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]


@pytest.mark.slow
def test_engine__converges_with_order_5(stepper):
    frequency, state, time = 0.5 / np.pi, [0.5, 0.3], 3.0
    exact = duffing_exactly(time, frequency, state)
    n = np.array([24, 32, 48, 64, 96])
    errors = [np.max(abs(stepper(DUFFING, frequency, state, time / k, k)[0] - exact)) for k in n]
    slope = np.polyfit(np.log(n), np.log(errors), 1)[0]
    assert -slope == pytest.approx(5.0, abs=0.2)


def test_engine__error_estimate_has_order_5(stepper):
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


@inline
def _one_layer(y, dy, c):
    # the value is x, the half-width 0.01, the strength that of a jump of 50
    return ((y[0], dy[0], 0.0 * y[0] + 0.01, 0.0 * y[0] + 1.0 / (0.01 * 50.0)),)


def step_of(rows, w, name):
    row = getattr(rows, name)
    return w[row : row + WIDTH]


def rough_hypot(a, b):
    """Within 2.2 % of the hypotenuse (see `vecmath.hypot_rough`)."""
    value = np.maximum(np.maximum(a, b), 0.898 * np.maximum(a, b) + 0.486 * np.minimum(a, b))
    assert np.allclose(value, np.hypot(a, b), rtol=0.022, atol=0.0)
    return value


def limits(slack, x, rate, passed, remaining, widths, ratios, fades):
    """Bounds of the docstring of `choose_step`, one row each: the layer, the edge behind, the edge ahead.

    Also where the layer's bound is about to end.
    """
    c = (slack * abs(rate) / (0.01 * 50.0)) ** (1.0 / 6.0)
    away, width = abs(x / rate), abs(0.01 / rate)
    towards = np.maximum(c * away / (1.0 + c), c * width)
    behind_it = c * rough_hypot(away, width)
    reach = width * np.maximum(FADED - 1.32 * np.log2(c), 1.0)
    if fades:
        towards = np.maximum(towards, np.minimum(away - reach, 0.9 * away))
        behind_it = np.where(away > reach, np.inf, behind_it)
    layer = np.where(x * rate < 0.0, towards, behind_it)
    behind = ratios[0] * rough_hypot(passed, widths[0])
    ahead = np.maximum(ratios[1] * remaining / (1.0 + ratios[1]), ratios[1] * widths[1])
    return np.array([layer, behind, ahead]), fades & (abs(away - reach) < 0.01 * reach)


@pytest.mark.slow
@pytest.mark.parametrize("fades", [False, True])
def test_choose_step__keeps_the_distance_from_layers_and_edges(oscillator, fades):
    system = dataclasses.replace(oscillator, n_edges=2, has_layers=True, layers=_one_layer, layers_fade=fades)
    part, rows = engine_bindings(system, RECORD)["choose_step"], rows_of(system)
    choose_step = njit(lambda w, base, slack: part(w, base, slack))
    rng = np.random.default_rng(5)
    slack, tightest = 1e-3, np.zeros(4, int)
    for _ in range(50):
        w = np.zeros(rows.size)
        x, rate = rng.uniform(-0.1, 0.1, WIDTH), rng.uniform(-3.0, 3.0, WIDTH)
        passed, remaining = 10.0 ** rng.uniform(-5.0, 0.0, (2, WIDTH))
        widths, ratios = 10.0 ** rng.uniform(-4.0, -2.0, (2, WIDTH)), rng.uniform(0.2, 2.0, (2, WIDTH))
        wish = 10.0 ** rng.uniform(-4.0, 0.0, WIDTH)
        fresh = rng.integers(0, 8, WIDTH) == 0
        for name, values in {
            "state": x,
            "slopes": rate,
            "time": 1.0 + passed,
            "start": 1.0,
            "wish": wish,
            "target": 1.0 + passed + remaining,
            "start_width": widths[0],
            "target_width": widths[1],
            "start_ratio": ratios[0],
            "target_ratio": ratios[1],
            "target_share": ratios[1] / (1.0 + ratios[1]),
            "fresh": fresh,
        }.items():
            step_of(rows, w, name)[:] = values
        choose_step(w, 0, slack)
        bounds, ending = limits(slack, x, rate, passed, remaining, widths, ratios, fades)
        bounds = np.vstack([bounds, wish])
        tightest += np.bincount(np.argmin(bounds, axis=0), minlength=4)
        share = bounds.min(axis=0) / remaining
        # the last two steps before the end share the rest; the last one ends there
        h = np.where(share >= 1.0, 1.0, np.where(share > 0.5, 0.5, share)) * remaining
        # the layer's bound is a rough power, good to a thousandth; next to a threshold either will do
        near = (abs(share - 1.0) < 3e-3) | (abs(share - 0.5) < 3e-3)
        good = np.isclose(step_of(rows, w, "step"), np.where(fresh, 0.0, h), rtol=2e-3, atol=0.0)
        assert (good | near | ending).all()
        assert near.sum() < 3
        assert ending.sum() < 4
        # times are sums of some units
        assert (step_of(rows, w, "step") <= remaining * (1.0 + 1e-9)).all()
    # each of the four was the tightest often
    assert tightest.min() > (20 if fades else 50)


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


def test_run_branches__angles_of_half_a_turn_stay_in_the_interval():
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


def oscillate(system, parameters, starts, frequency=1.0, n_points=1, **options):
    n = len(starts)
    settings = {"n_transient": 0, "n_keep": 3, "rtol": 1e-8, "atol": 1e-8, **options}
    full = np.array([[*s, 1.0, 0.0, 0.0, 1.0] for s in starts])
    packed = np.tile(np.array(parameters, dtype=float), (n, n_points, 1))
    return run_branches(packed, np.full((n, n_points), frequency), full, system=system, **settings)


@pytest.mark.slow
def test_run_branches__diverged_cells_and_what_follows_them(oscillator):
    # x'' = 9 x grows by e^3 a period: the first passes the bound of 1000 in its second period, the
    # derivatives of the second their bound of 1e6 in its fifth
    found = oscillate(oscillator, [0.0, -9.0, 0.0, 0.0], [[1.0, 3.0], [1e-9, 3e-9]], n_points=3)
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
    found = run_branches(packed, [[2.2, 2.2]], start, max_steps_per_period=20, **settings)
    assert found.status.tolist() == [[Status.STEP_LIMIT, Status.UNREACHED]]
    assert np.isnan(found.section).all()
    assert found.n_periods.tolist() == [[0, 0]]
    assert found.n_steps[0, 0] + found.n_rejected[0, 0] == 21
    # the limit is on each period, not on their sum
    free = run_branches(packed, [[2.2, 2.2]], start, **settings)
    most = int(np.max(free.n_steps + free.n_rejected))
    found = run_branches(packed, [[2.2, 2.2]], start, max_steps_per_period=most - 20, **settings)
    assert (found.status < Status.DIVERGED).all()


def test_run_branches__no_branches_no_work(preset):
    nothing = np.zeros((0, 2, 34)), np.zeros((0, 2)), np.zeros((0, 4))
    found = run_branches(*nothing, n_transient=1, n_keep=3, rtol=1e-6, atol=1e-6)
    assert found.section.shape == (0, 2, 3, 4)
    assert found.status.shape == (0, 2)


def test_run_branches__counts_periods_and_keeps_the_last(preset):
    start = [[0.2, 0.2, 0.0, 0.0]]
    for n_transient, n_keep in itertools.product((0, 3), (1, 4)):
        found = sections(preset, 2.2, start, n_transient=n_transient, n_keep=n_keep)
        every = sections(preset, 2.2, start, n_transient=0, n_keep=n_transient + n_keep)
        assert found.n_periods[0] == n_transient + n_keep
        assert (found.section[0] == every.section[0, n_transient:]).all()
