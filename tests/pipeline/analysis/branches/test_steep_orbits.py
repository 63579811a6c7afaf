"""Limit cycles that are cut into segments, against closed forms and shooting over the whole period."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magpend_core.crossing import Crossing
from magpend_core.models.sectioned import sectioned
from pipeline.analysis.branches.arclength import Settings, correct, kernel_of
from pipeline.analysis.branches.lockstep import Query, run_alone
from pipeline.analysis.branches.problems import OrbitProblem
from pipeline.analysis.branches.starting_orbits import family_of
from pipeline.analysis.branches.steep_orbits import cut_where_steep, graded_multipliers, whole_orbit
from tests.core.flows import BAUTIN, flow


def segments(blocks, count, seed=0):
    """Derivatives of segments with a flow's direction each, whose product has multipliers 1 and those of blocks."""
    random, n = np.random.default_rng(seed), 1 + sum(len(block) for block in blocks)
    frames = random.normal(size=(count, n, n)) + 2.0 * np.eye(n)
    steps = np.zeros((count, n, n))
    for k in range(count):
        steps[k, 0, 0], first = 1.0, 1
        for block in blocks:
            own = slice(first, first + len(block))
            size = float(np.abs(np.linalg.det(block)) ** (1.0 / len(block)))
            steps[k, own, own] = size ** (1.0 / count) * (np.array(block) / size if k == 0 else np.eye(len(block)))
            first += len(block)
    tangents = np.array([frames[(k + 1) % count] @ steps[k] @ np.linalg.inv(frames[k]) for k in range(count)])
    return tangents, frames[:, :, 0]


def test_graded_multipliers__as_many_digits_for_the_small_ones():
    turn = 3e2 * np.array([[np.cos(1.0), -np.sin(1.0)], [np.sin(1.0), np.cos(1.0)]])
    tangents, speeds = segments([[[-1e-9]], turn, [[6e8]], [[1.0]]], 24)
    found = graded_multipliers(tangents, speeds)
    known = np.array([6e8, 3e2 * np.exp(1j), 3e2 * np.exp(-1j), 1.0, -1e-9, 0.0])
    np.testing.assert_allclose(np.abs(found), np.abs(known), rtol=1e-8)
    np.testing.assert_allclose(found.real, known.real, rtol=1e-8)
    # the product of the matrices holds no digit of the least one
    whole = np.linalg.eigvals(np.linalg.multi_dot(tangents[::-1]))
    assert np.abs(whole + 1e-9).min() > 1e-10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of", "period"), [("y", 1), ("y", 2), ("y + 0.3*x*y - 3*(mu - 0.1)", 1), ("y + 0.3*x*y - mu + 0.1", 2)]
)
def test_cut_problem__is_the_orbit_of_the_whole_period(of, period):
    """The circle whose squared radius s has mu + s - s^2 = 0, once and twice; a turn has the multiplier
    exp(2 pi s (1 - 2 s)). The curved sections lie at y = 0 as well, and move with the parameter.
    """
    parameters = sectioned(flow(BAUTIN), Crossing(of, 0.0, longest=50.0)).load(mu=0.1)
    family = family_of(parameters.model.system, 1, 0.02, parameters.pack(), "mu", 0.6)
    family = replace(family, period=period)
    s = 0.5 + np.sqrt(0.35)
    u = family.unknowns([np.sqrt(s), 0.0], [0.1])
    settings, normal = Settings(), np.array([0.0, 0.0, 1.0])
    whole = run_alone(correct(OrbitProblem(family), u, normal, settings))
    assert whole is not None
    problem, point = run_alone(cut_where_steep(*whole_orbit(family, whole), whole.tangent, settings))
    assert point.residual < 1e-10
    assert len(problem.shares) == 16
    np.testing.assert_allclose(problem.parts(point.u)[0][0], [np.sqrt(s), 0.0], atol=1e-10)
    assert point.value.seconds == pytest.approx(period * np.pi, rel=1e-11)
    assert point.value.multipliers == pytest.approx([np.exp(2.0 * np.pi * period * s * (1.0 - 2.0 * s)), 0.0], rel=1e-8)
    plain = problem.plain(point)
    np.testing.assert_allclose(plain.value.derivative, whole.value.derivative, atol=1e-6)
    np.testing.assert_allclose(plain.value.images, whole.value.images, atol=1e-9)
    np.testing.assert_allclose(plain.value.monodromy, whole.value.monodromy, atol=1e-9)
    np.testing.assert_allclose(abs(plain.tangent @ kernel_of(whole.value)), 1.0, atol=1e-6)
    step = 1e-6 * np.eye(problem.size)
    ends = [run_alone(asked(problem, point.u + h)).residual for h in (*step, *-step)]
    np.testing.assert_allclose(
        point.value.derivative.T, (np.array(ends[: problem.size]) - ends[problem.size :]) / 2e-6, atol=1e-5
    )
    # a return longer than any may be is none
    late = replace(problem, unit=20.0 * problem.unit)
    assert not run_alone(asked(late, point.u)).is_finite


def asked(problem, u):
    return (yield Query(problem, u))
