"""Published basins, through the engine's and the analyses' public functions: Duffing, a pendulum."""

import numpy as np
import pytest

from magpend_core import load_model
from magpend_core.engine.vecmath import TWO_PI
from pipeline.analysis.basins.numbers import binomial_interval
from pipeline.layout.vocabulary import ABSENT, PERIODIC_ORBIT
from tests.core.cells import run_cells
from tests.pipeline.analysis.cubes import WELLS, cube_of, integrated
from tests.pipeline.analysis.dense_sets import identify

UNIT_FREQUENCY = 1.0 / TWO_PI  # forcing cos t


DUFFING = load_model("duffing").system
TWO_WELLS = load_model("duffing").load("twin-well-periodic")  # x'' = .2 cos t + x - x^3 - .15 x'


def grid(n, x, y):
    """Middles of n x n cells on x times y, shape (n * n, 2)."""
    middles = (np.arange(n) + 0.5) / n
    sides = (low + (high - low) * middles for low, high in (x, y))
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)


# ---- two wells ---------------------------------------------------------------------------------

STARTS = grid(40, (-2.2, 2.2), (-2.2, 2.2))


@pytest.fixture(scope="module")
def two_wells():
    """The starts integrated until their orbits close, as a cube."""
    options = {"n_transient": 400, "n_keep": 16, "stop_when_closed": True, "max_orbit_period": 4}
    result = integrated(TWO_WELLS, UNIT_FREQUENCY, STARTS, rtol=1e-8, atol=1e-8, **options)
    return cube_of(result, DUFFING.state_names, frequency=UNIT_FREQUENCY)


@pytest.fixture(scope="module")
def found_wells(two_wells):
    return identify(two_wells, system=DUFFING, parameters=TWO_WELLS.pack())


def test_fractions__duffing_as_published(found_wells):
    # by the least point: the left one first
    assert np.max(abs(found_wells["attractor_points"].values[:, 0] - WELLS)) < 1e-9
    ids = found_wells["attractor_id"].values
    # on 200 x 200 cells; the interval, which takes the cells for independent, has room for our 40 x 40
    for label, published in enumerate((0.498, 0.502)):
        low, high = binomial_interval((ids == label).sum(), (ids >= 0).sum(), method="clopper-pearson")
        assert low <= published <= high
        assert (ids == label).sum() / (ids >= 0).sum() == pytest.approx(published, abs=0.02)


def runge_kutta(starts, n_periods, n_steps):
    """Duffing sections after `n_periods`, by the classical method with fixed steps."""
    x, v = starts.T.copy()
    h = TWO_PI / n_steps

    def rates(t, x, v):
        return v, 0.2 * np.cos(t) + x - x * x * x - 0.15 * v

    for i in range(n_periods * n_steps):
        t = h * (i % n_steps)
        a, b = rates(t, x, v)
        c, d = rates(t + 0.5 * h, x + 0.5 * h * a, v + 0.5 * h * b)
        e, f = rates(t + 0.5 * h, x + 0.5 * h * c, v + 0.5 * h * d)
        g, k = rates(t + h, x + h * e, v + h * f)
        x, v = x + h / 6.0 * (a + 2.0 * (c + e) + g), v + h / 6.0 * (b + 2.0 * (d + f) + k)
    return np.stack([x, v], axis=-1)


def test_identify__duffing_cells_go_where_another_integrator_takes_them(found_wells):
    # transients are chaotic: after 30 periods each integrator and tolerance has labels of its own for
    # hundreds of cells. What is settled after ten is not in doubt, but for errors of a long step.
    ends = runge_kutta(STARTS, 10, 200)
    distance = np.abs(ends[:, None] - WELLS).max(axis=-1)
    settled = distance.min(axis=1) < 0.05
    assert settled.mean() > 0.4
    differ = found_wells["attractor_id"].values != distance.argmin(axis=1)
    assert np.count_nonzero(differ & settled) <= 3


# ---- rest and rotation -------------------------------------------------------------------------

TORQUES = np.array([0.11, 0.16, 0.26, 0.36, 0.51, 0.71, 0.96])
REST_FRACTIONS = [1.0, 0.483, 0.327, 0.238, 0.147, 0.065, 0.007]
"""Of the pendulum with constant torque, recomputed after bSTAB's first case; each +- .02."""


def rest_fraction(torques, n):
    """Fractions of rest on n x n starts, and what `identify` found."""
    rest, model = np.arcsin(0.5), load_model("driven-pendulum")
    starts, system, own = (
        grid(n, (rest - np.pi, rest + np.pi), (-10.0, 10.0)),
        model.system,
        model.load("constant-torque"),
    )
    packed = np.tile(own.pack(), (len(torques) * len(starts), 1))
    packed[:, model.parameter_names.index("bias")] = np.repeat(torques, len(starts))
    # without forcing any time between sections will do; ten time units have a rotation's phase drift
    options = {"n_transient": 40, "n_keep": 30, "closure_tolerance": 1e-4, "max_orbit_period": 1}
    result = run_cells(system, packed, 0.1, np.tile(starts, (len(torques), 1)), **options)
    dims, shape = ("bias", "initial_condition"), (len(torques), len(starts))
    ds = cube_of(result, system.state_names, dims, shape, frequency=0.1, bias=torques)
    # not polished: at rest, steps that the trajectory alone controls grow too long for its tangents
    found = identify(ds, system=system, parameters=own.pack(), polish=False, tolerance=1e-3)
    turning = np.abs(found["rotation"].isel(angle=0)) > 0.1
    at_rest = (found["kind"] == PERIODIC_ORBIT) & (np.abs(found["rotation"].isel(angle=0)) < 1e-3)
    assert ((found["kind"] == ABSENT) | turning | at_rest).all()
    ids = found["attractor_id"]
    assert (ids >= 0).all()
    label = ids.copy(data=np.take_along_axis(turning.values, ids.values, axis=1).astype(int))
    return (label == 0).mean("initial_condition").values, found


def test_fractions__rest_against_torque_as_published():
    fractions, found = rest_fraction(TORQUES, 40)
    assert fractions == pytest.approx(REST_FRACTIONS, abs=0.02)
    # below 4 damping/pi (to first order) no rotation lasts; above, there is rest and rotation
    turns = (np.abs(found["rotation"].isel(angle=0)) > 0.1).any("attractor")
    assert turns.values.tolist() == [False, True, True, True, True, True, True]


def test_fractions__rest_at_torque_one_half_as_published():
    fractions, found = rest_fraction(np.array([0.5]), 60)
    assert fractions.item() == pytest.approx(0.152, abs=0.008)
    at_rest = found.isel(bias=0, attractor=found["kind"].values[0].argmin())
    assert at_rest["attractor_points"].values[0] == pytest.approx([np.arcsin(0.5), 0.0], abs=1e-5)
