"""Equilibria at which cells come to rest that no longer cross the section."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import expm

from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.analysis.attractors.finding.equilibria import _path_to, _settled
from pipeline.analysis.attractors.finding.held import SHARES, rates_shown
from pipeline.analysis.attractors.finding.known_sets import Equilibrium
from pipeline.results.sets import Geometry
from pipeline.runs.derive import derive
from tests.core.flows import table
from tests.pipeline.analysis.cubes import line, sweep

LINE = Geometry((False,), (1.0,))


def rest(x, rate=-1.0):
    return Equilibrium(np.array([x]), np.array([rate + 0j]), 0.0, np.array([[rate]]))


def test_settled__a_cell_belongs_to_the_equilibrium_that_it_contracts_to():
    point = SimpleNamespace(equilibria=[rest(0.0), rest(0.06)], frequency=1.0)
    decay = 0.02 * np.exp(-np.arange(3.0))
    path = np.stack([decay, 0.06 - decay, np.linspace(0.05, 0.03, 3)])[:, :, None]
    waits = np.ones(3, bool)
    assert _settled(point, path, waits, 1e-6, LINE).tolist() == [0, 1, -1]
    # the last states alone show nothing unless they are at the equilibrium
    last = _path_to(np.array([[0.0], [0.06], [1e-3]]))
    assert _settled(point, last, waits, 1e-6, LINE).tolist() == [0, 1, -1]


def test_settled__of_two_equilibria_within_the_tolerance_the_nearer_one():
    point = SimpleNamespace(equilibria=[rest(0.0), rest(1e-3)], frequency=1.0)
    path = _path_to(np.array([[1e-4], [9e-4]]))
    assert _settled(point, path, np.zeros(2, bool), 1e-2, LINE).tolist() == [0, 1]


@pytest.mark.slow
def test_attractors__two_rests_closer_than_a_tenth(computed):
    """Rests at 0 and 0.08, divided at 0.03: no cell crosses the section at 0.05 upwards again and again."""
    spec = sweep(
        table("rests", {"u": "-1000*u*(u - 0.03)*(u - 0.08)"}),
        {"kind": "grid", "u": line(0.001, 0.201, 30)},
        section={"of": "u", "value": 0.05, "direction": "up", "longest": 100.0},
        lengths=(20, 10),
    )
    rows = attractors_table(derive(computed(spec), "attractors")).rows
    assert [(row["kind"], row["n_cells"]) for row in rows] == [("equilibrium", 5), ("equilibrium", 25)]


def test_rates_shown__turns_are_counted_and_a_direction_that_vanishes_at_once_has_no_finite_rate():
    """A focus that turns by 8 radians in the longest time, in a plane onto which the third direction falls."""
    focus, onto = np.array([[-1.0, -2.0, 0.0], [2.0, -1.0, 0.0], [0.0, 0.0, 0.0]]), np.diag([1.0, 1.0, 0.0])
    onto[:2, 2] = 0.3, -0.7
    matrices = np.array([expm(focus * t) @ onto for t in 4.0 * SHARES])
    eigenvalues, jacobian, time = rates_shown(4.0 * SHARES, matrices)
    assert eigenvalues[:2] == pytest.approx([-1.0 - 2.0j, -1.0 + 2.0j], rel=1e-9)
    assert eigenvalues[2].real == -np.inf
    np.testing.assert_allclose(expm(jacobian * time), expm(focus * time) @ onto, atol=1e-8)


def test_rates_shown__nothing_where_even_the_shortest_time_is_too_long():
    assert rates_shown(np.array([1.0]), np.array([[[0.01]]])) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "seen", [{"frequency_hz": 0.25}, {"section": {"of": "c", "value": 5.0, "direction": "up", "longest": 100.0}}]
)
def test_attractors__rest_on_a_switch_is_an_equilibrium_of_the_sliding_flow(computed, seen):
    """The rates of c are 1 below its bound and -2 above; on it a and b spiral to 0 with the eigenvalues -1 +- 2i."""
    rates = {"a": "-a - 2*b", "b": "2*a - b", "c": "1 + a - where(c > bound, 3, 0)"}
    starts = [[0.3, 0.1, 0.0], [-0.2, 0.4, 1.5], [0.1, -0.3, 0.7]]
    spec = sweep(table("held", rates, {"bound": 0.7}), starts, lengths=(20, 10), **seen)
    (row,) = attractors_table(derive(computed(spec), "attractors")).rows
    assert (row["kind"], row["stability"], row["n_cells"]) == ("equilibrium", "attracts", 3)
    assert (row["eigenvalue_real"], abs(row["eigenvalue_imag"])) == pytest.approx((-1.0, 2.0), rel=1e-6)
