"""Cells that stopped far from their orbits: the labels and periods of a strict run."""

from functools import cache

import numpy as np
import pytest

from magpend_core import load_preset, sections
from pipeline.analysis.attractors.finding.assigning import decide
from pipeline.analysis.attractors.finding.cell_blocks import Block
from pipeline.analysis.attractors.finding.closed_orbits import Orbit
from pipeline.layout.vocabulary import ATTRACTS, CLOSED, EXTENDED, PERIODIC_ORBIT, UNDECIDED
from pipeline.results.sets import Geometry
from tests.pipeline.analysis.cubes import STATES, cube_of
from tests.pipeline.analysis.dense_sets import identify


@cache
def run(frequency, closure_tolerance, n=8, n_transient=3000):
    """Cube of n x n starts at rest within 1 rad, each stopped once it has closed."""
    line = np.linspace(-0.95, 1.0, n)
    starts = np.zeros((n * n, 4))
    starts[:, :2] = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    closing = {"stop_when_closed": True, "closure_tolerance": closure_tolerance}
    result = sections(load_preset(), frequency, starts, n_transient=n_transient, n_keep=16, **closing)
    return cube_of(result, STATES, frequency=frequency).assign_attrs(closure_tolerance=closure_tolerance)


def orbit_of_cells(found):
    """First section point and period of the orbit of each cell; 0 for a chaotic transient that goes on.

    One cell in 64 may be one: how long it lasts changes with the last bit of the arithmetic.
    """
    rows = found["attractor_id"].values
    on_orbit = (rows >= 0) & (found["kind"].values[rows] == PERIODIC_ORBIT)
    assert (~on_orbit).sum() <= 1
    return found["attractor_points"].values[rows, 0], np.where(on_orbit, found["orbit_period"].values[rows], 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("frequency", "periods"),
    [
        (2.2, {1, 5, 7}),
        (2.48, {2}),  # past the period doubling: 0.04 rad between the two sections
    ],
)
def test_identify__loose_closure_gives_the_labels_of_a_strict_run(frequency, periods):
    strict, loose = (run(frequency, tolerance) for tolerance in (1e-5, 2e-2))
    assert loose["n_periods"].sum() < 0.6 * strict["n_periods"].sum()
    expected, found = (identify(ds, parameters=load_preset()) for ds in (strict, loose))
    closed = found["kind"].values == PERIODIC_ORBIT
    assert found["is_polished"].values[closed].all()
    assert (found["stability"].values[closed] == ATTRACTS).all()
    (points, period), (seen, seen_period) = orbit_of_cells(expected), orbit_of_cells(found)
    both = (period > 0) & (seen_period > 0)
    assert set(period[both]) == periods
    assert np.array_equal(seen_period[both], period[both])
    assert np.abs(seen - points)[both].max() < 1e-8


@pytest.mark.slow
def test_identify__loose_closure_sees_half_the_period():
    """What the run itself says of these cells is not what they are."""
    ds = run(2.48, 2e-2)
    found = identify(ds, parameters=load_preset())
    _, period = orbit_of_cells(found)
    assert (ds["orbit_period"].values == 1).mean() > 0.9
    assert set(period) - {0} == {2}
    assert {CLOSED, EXTENDED} <= set(found["decision"].values.tolist())
    order = np.random.default_rng(1).permutation(64)
    other = identify(ds.isel(initial_condition=order), parameters=load_preset(), block_bytes=30_000)
    for name in ("attractor_points", "multiplier_real", "n_cells", "rotation", "state_min"):
        assert np.array_equal(other[name].values, found[name].values, equal_nan=True), name
    for name in ("attractor_id", "decision"):
        assert np.array_equal(other[name].values, found[name].values[order])


@pytest.mark.slow
def test_identify__tolerance_follows_the_run():
    ds = run(2.2, 1e-3, n=2)
    assert identify(ds, parameters=load_preset()).attrs["identify_tolerance"] == pytest.approx(1e-2)
    tight = ds.assign_attrs(closure_tolerance=1e-7)
    assert identify(tight, polish=False).attrs["identify_tolerance"] == pytest.approx(1e-4)
    with pytest.raises(ValueError, match="tolerance"):
        identify(ds, polish=False, tolerance=-1e-3)


# ---- by hand ------------------------------------------------------------------------------------

PLANE = Geometry((True, False), (1.0, 10.0))


def decision_of(offset, tolerance, modulus=0.5):
    """Decision on a closed cell that stands beside an orbit, and so cannot be a spiral."""
    matrix = np.diag([modulus, 0.1])
    orbit = Orbit(np.array([[0.2, 1.0]]), np.array([modulus, 0.1 + 0j]), 1e-12, matrix)
    section = np.tile([0.2 + offset, 1.0], (1, 16, 1))
    block = Block(slice(0, 1), section, np.array([1]), np.array([1]), np.zeros((1, 1), int))
    return decide(block, [orbit], tolerance, PLANE)[1].item()


def test_decide__loosely_closed():
    assert decision_of(0.019, 0.2) == CLOSED
    assert decision_of(0.021, 0.2) == UNDECIDED
    assert decision_of(9e-4, 1e-3) == CLOSED
    assert decision_of(0.001, 0.2, modulus=1.1) == UNDECIDED
    assert decision_of(5e-4, 1e-3, modulus=1.1) == CLOSED
