"""Equilibria at which cells come to rest that no longer cross the section."""

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.analysis.attractors.finding.equilibria import _path_to, _settled
from pipeline.analysis.attractors.finding.known_sets import Equilibrium
from pipeline.analysis.sets import Geometry
from pipeline.runs.derive import derive
from tests.core.flows import table

from .cubes import line, sweep

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
