"""Branches of orbits whose impact passes through the instant of the sections."""

import math

import numpy as np
import pytest

from magpend_core import load_model
from pipeline.analysis.branches.arclength import Settings
from pipeline.analysis.branches.connecting import connect
from pipeline.analysis.branches.following import first_point, half_branch, opposite, problem_of
from pipeline.analysis.branches.lockstep import run_alone
from pipeline.analysis.branches.problems import FREQUENCY, Family
from pipeline.analysis.branches.sheets import Axis, Grid
from pipeline.analysis.branches.strobe import other_side
from tests.core.cells import polish, run_cells

# x'' + 0.1 x' + x = cos(w t) left of a wall at 1; the orbit of one impact has it at phase 0 where w is PHASE_0
STRUCK = load_model("impact").load(zeta=0.05, A=1.0, gap=1.0, r=0.8)
SYSTEM, PACKED = STRUCK.model.system, STRUCK.pack()
PHASE_0 = 0.9031765032
TURN = 2.0 * math.pi


def orbit_at(omega):
    """Section point of the orbit of one impact."""
    frequency = omega / TURN
    found = run_cells(SYSTEM, PACKED, frequency, [[0.5, -1.0]], n_transient=200, rtol=1e-9)
    closed = polish(STRUCK, found.section[:, 0, -1], 1, frequency)
    assert closed.converged[0]
    return closed.section[0]


def family_at(omega):
    return Family(SYSTEM, 1, omega / TURN, PACKED, (FREQUENCY,), (1.0 / TURN,))


@pytest.mark.slow
def test_other_side__is_the_state_before_or_after_the_impact():
    for away in (-1e-6, -1e-3, 1e-6, 1e-3):
        omega = PHASE_0 + away
        here = orbit_at(omega)
        x, v = other_side(SYSTEM, here, PACKED, omega / TURN, 1)
        # later in phase as omega rises: first after the section, then before it
        assert v == pytest.approx(-here[1] / 0.8 if away < 0.0 else -0.8 * here[1], abs=5.0 * abs(away))
        assert (x - 1.0) * (here[0] - 1.0) < 0.0
    assert other_side(SYSTEM, orbit_at(1.2), PACKED, 1.2 / TURN, 1) is None


@pytest.mark.slow
@pytest.mark.parametrize("way", [1, -1])
def test_half_branch__goes_on_through_the_instant_of_the_sections(way):
    begin, end = (0.9, 0.906)[::way]
    family, settings = family_at(begin), Settings()
    start = run_alone(first_point(problem_of(family), family.unknowns(orbit_at(begin), [begin / TURN]), settings))
    start = start if way > 0 else opposite(start)
    half = run_alone(half_branch(family, start, 0.9 / TURN, 0.906 / TURN, settings))
    assert half.trace.end == "bound"
    assert half.bifurcations == []
    last = half.trace.points[-1]
    assert family.values(last.u)[0] * TURN == pytest.approx(end, abs=1e-12)
    assert family.state(last.u) == pytest.approx(orbit_at(end), abs=1e-8)
    for point in half.trace.points:
        # areas shrink by r^2 and by the friction of a period; the multipliers turn smoothly
        multipliers = np.linalg.eigvals(point.value.monodromy)
        omega = family.values(point.u)[0] * TURN
        assert multipliers.prod() == pytest.approx(0.64 * math.exp(-0.1 * TURN / omega), rel=1e-8)
        assert multipliers.real == pytest.approx(-0.4446 - 2.82 * (omega - PHASE_0), abs=1e-3)


@pytest.mark.slow
def test_connect__links_orbits_on_both_sides_of_the_instant_of_the_sections():
    values = np.array([0.88, 0.95]) / TURN
    grid = Grid(SYSTEM, (2,), np.tile(PACKED, (2, 1)), values.copy(), (Axis(0, -1, values),))
    found = connect(grid, np.arange(2), [orbit_at(v * TURN)[None] for v in values])
    assert found.links[:, :2].max(initial=0) == 1 or len(found.links) == 2
    linked = {frozenset(link[:2]) for link in found.links.tolist()}
    assert frozenset((0, 1)) in linked
