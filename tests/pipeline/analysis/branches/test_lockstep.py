"""Continuations side by side: the logistic map in numpy in place of the engine, with its doublings on paper."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from magpend_core.engine.simd import WIDTH
from pipeline.analysis.branches import exploring, lockstep
from pipeline.analysis.branches.arclength import Point, Settings
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.following import Branch, first_point
from pipeline.analysis.branches.kinds import DOUBLING
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.lockstep import Begun, _filling, run_alone, run_together
from pipeline.analysis.branches.problems import Ends, Family, OrbitProblem

SYSTEM = SimpleNamespace(
    label="logistic",
    n_states=1,
    state_names=("x",),
    parameter_names=("r",),
    scales=(1.0,),
    is_angle=(False,),
    section=None,
)
SCOPE = Scope(2.8, 3.55, max_period=4, settings=Settings(first_step=0.01, longest_step=0.05))


def orbits(period: int = 1) -> Family:
    return Family(SYSTEM, period, 1.0, np.array([0.0]), ("r",), (1.0,))


def start(r: float) -> Start:
    """Return the fixed point at a value of r."""
    return Start(orbits(), np.array([1.0 - 1.0 / r]), r)


@pytest.fixture
def calls(monkeypatch) -> list[int]:
    """Numbers of trajectories in each call of the map that stands for the engine."""
    found = []

    def integrated(rows, system, rtol=0.0):
        found.append(sum(len(r.states) for r in rows))
        return [iterated(r) for r in rows]

    monkeypatch.setattr(lockstep, "integrated", integrated)
    monkeypatch.setattr(exploring, "judge", lambda _: None)  # normal forms need the engine
    return found


def iterated(rows) -> Ends:
    x, r, slope, images = rows.states, rows.parameters, np.ones_like(rows.states), []
    for _ in range(rows.period):
        slope, x = slope * r * (1.0 - 2.0 * x), r * x * (1.0 - x)
        images.append(x)
    return Ends(rows.states, np.stack(images, axis=1), slope[:, :, None], np.ones((len(x), rows.period)))


def points_of(branches: list[Branch]) -> list[Point]:
    return [p for b in branches for p in (*b.points, *(one.point for one in b.bifurcations))]


def test_explore__doubled_branches_begin_beside_the_others(calls, monkeypatch) -> None:
    """Doublings at 3 and 1 + sqrt(6): their branches are followed in fewer calls, to the same bits."""
    found = explore([start(2.9)], SCOPE)
    doublings = [float(one.point.u[-1]) for b in found for one in b.bifurcations if one.kind == DOUBLING]
    assert [b.family.period for b in found] == [1, 2, 4]
    np.testing.assert_allclose(doublings, [3.0, 1.0 + np.sqrt(6.0), 3.5440903596], atol=1e-7)
    n_beside = len(calls)
    calls.clear()
    monkeypatch.setattr(exploring._Doubled, "beside", lambda *_: ())
    later = explore([start(2.9)], SCOPE)
    assert n_beside < 0.9 * len(calls)
    for a, b in zip(points_of(found), points_of(later), strict=True):
        np.testing.assert_array_equal(np.append(a.u, a.tangent), np.append(b.u, b.tangent))


def test_doubled__begins_no_branch_that_another_may_be(calls) -> None:
    """The branch of period 2 that is being followed ends at the doubling, from which nothing is begun."""
    two = Start(orbits(2), np.array([0.7994554904673701]), 3.2)
    begun = []
    _Doubled = exploring._Doubled
    branch = _Doubled._branch
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Doubled, "_branch", lambda *a: begun.append(a[1].period) or branch(*a))
        found = explore([start(3.2), two], SCOPE)
    assert sorted(b.family.period for b in found) == [1, 2, 4]
    assert begun == [2]  # the doubling of period 2 alone: nothing of period 4 has been followed


def test_run_together__computations_beside_get_their_results_later(calls) -> None:
    def refined() -> lockstep.Steps[Point | None]:
        return first_point(OrbitProblem(orbits()), np.array([0.6, 2.9]), SCOPE.settings)

    begun = Begun(refined())
    (one,) = run_together([refined()], beside=lambda _: [begun])
    n_calls = len(calls)
    other = run_alone(begun.rest())
    assert len(calls) == n_calls  # it has ended beside the first
    np.testing.assert_array_equal(one.u, other.u)
    assert one.u[0] == pytest.approx(1.0 - 1.0 / 2.9, abs=1e-10)


@pytest.mark.parametrize(
    ("sizes", "chosen"),
    [
        ([2, 4, 2], [0, 1, 2]),  # less than a group
        ([4] * 5, [0, 1, 2, 3]),  # four trajectories wait
        ([4] * 7, list(range(7))),  # a second group that is almost full
        ([WIDTH + 2, 2], [0]),  # the first one in any case
        ([8, 0, 8, 4], [0, 1, 2]),  # equilibria never wait
        ([0], [0]),
    ],
)
def test_filling__whole_groups_of_lanes(sizes: list[int], chosen: list[int]) -> None:
    assert WIDTH == 16
    assert _filling(sizes) == chosen
