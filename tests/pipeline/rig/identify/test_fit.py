"""The fit: residuals, slopes and optima against scipy's integrator, closed forms and known truths."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from magpend_core.models import load_model
from magpend_core.sampling import Drive
from pipeline.rig.identify.drifts import drift_warnings
from pipeline.rig.identify.local import fit_local, fit_starts
from pipeline.rig.identify.objective import _steps, evaluate
from pipeline.rig.identify.problem import Free, Piece, Problem
from pipeline.rig.identify.search import cut, search, slowest_period, sobol

MODEL = load_model("duffing")
TRUTH = {"damping": 0.15, "linear": 3.0, "cubic": 0.8, "amplitude": 1.2}
FREQUENCY = 0.31
ZERO = 0.02
NOISE = 1e-3


def motion(p, start, time, phase_s=0.0):
    """The oscillator by scipy, from its equation."""

    def rhs(t, y):
        force = p["amplitude"] * np.cos(2 * np.pi * FREQUENCY * (t + phase_s))
        return [y[1], force - p["damping"] * y[1] - p["linear"] * y[0] - p["cubic"] * y[0] ** 3]

    return solve_ivp(rhs, (0, time[-1]), start, "DOP853", time, rtol=1e-10, atol=1e-10).y.T


def drive_from(phase_s):
    return Drive(np.full(9, 1 / FREQUENCY)).window(phase_s, phase_s + 8.0)


STARTS = np.array([[1.5, 0.0], [-0.6, 1.1], [0.3, -2.0]])


def make_problem(noise=0.0, free=("damping", "linear", "cubic", "amplitude"), **more):
    rng = np.random.default_rng(7)
    time = np.arange(161) * 0.05
    pieces = []
    for k, start in enumerate(STARTS):
        phase = 0.7 * k
        x = motion(TRUTH, start, time, phase)[:, :1] + ZERO + noise * rng.normal(size=(161, 1))
        guess = start + np.array([0.01, -0.02])
        pieces.append(Piece(0, k, time, x, guess, drive_from(phase)))
    unknowns = tuple(Free(n, 1.25 * TRUTH[n], 0.0, 10.0) for n in free)
    unknowns += (Free("zero.x", 0.0, -0.5, 0.5),)
    fixed = MODEL.load(**TRUTH)
    return Problem(MODEL, fixed, unknowns, ("x",), tuple(pieces), np.array([NOISE]), rtol=1e-9, **more)


def truth_of(problem):
    return np.array([TRUTH.get(name, ZERO) for name in problem.names])


def brute_rows(problem, theta, starts):
    """Residuals in units of the noise, by scipy, all rows."""
    values = {**TRUTH, **{n: v for n, v in zip(problem.names, theta, strict=True) if n in TRUTH}}
    rows = []
    for k, piece in enumerate(problem.pieces):
        x = motion(values, starts[k], piece.time, 0.7 * k)[:, 0] + theta[-1]
        rows.append((piece.measured[:, 0] - x) / NOISE)
    return np.concatenate(rows)


def brute_jacobian(problem, theta, starts):
    whole = np.append(theta, starts.ravel())
    columns, n = [], len(theta)
    for i in range(len(whole)):
        h = 1e-5 * max(abs(whole[i]), 0.1)
        sides = [whole + s * h * np.eye(len(whole))[i] for s in (1, -1)]
        a, b = (brute_rows(problem, w[:n], w[n:].reshape(starts.shape)) for w in sides)
        columns.append((a - b) / (2 * h))
    return np.column_stack(columns)


@pytest.mark.slow
@pytest.mark.parametrize("slopes", ["differences", "variational"])
def test_evaluate__has_the_cost_and_the_normal_equations_of_all_samples(slopes):
    """The compressed rows stand for all of them: same cost, gradient and normal matrix as by brute force."""
    problem = make_problem(slopes=slopes)
    theta = truth_of(problem) * 1.02
    found = evaluate(problem, theta[None], problem.starts[None], slopes=True)[0]
    rows, jacobian = (brute_rows(problem, theta, problem.starts), brute_jacobian(problem, theta, problem.starts))
    assert len(found.rows) < len(rows) / 10
    assert found.cost == pytest.approx(0.5 * rows @ rows, rel=1e-5)
    size = np.linalg.norm(jacobian, axis=0)
    normal = (jacobian.T @ jacobian) / np.outer(size, size)
    np.testing.assert_allclose(found.jacobian.T @ found.jacobian / np.outer(size, size), normal, atol=2e-4)
    gradient = jacobian.T @ rows / size / np.linalg.norm(rows)
    np.testing.assert_allclose(found.jacobian.T @ found.rows / size / np.linalg.norm(rows), gradient, atol=2e-4)


def test_evaluate__of_a_population_is_that_of_each_alone():
    problem = make_problem()
    thetas = truth_of(problem) * np.array([[0.9], [1.0], [1.1]])
    starts = np.stack([problem.starts, problem.starts + 0.1, problem.starts - 0.1])
    together = evaluate(problem, thetas, starts, slopes=False)
    for i, one in enumerate(together):
        alone = evaluate(problem, thetas[i : i + 1], starts[i : i + 1], slopes=False)[0]
        np.testing.assert_array_equal(one.rows, alone.rows)


@pytest.mark.parametrize("loss", ["soft_l1", "huber", "cauchy"])
def test_evaluate__counts_a_robust_loss_as_scipy_does(loss):
    problem = make_problem(loss=loss, loss_scale=3.0)
    theta = truth_of(problem) * 1.001
    z = brute_rows(problem, theta, problem.starts)
    asked = least_squares(lambda x: z + 0 * x, [0.0], jac=lambda x: np.zeros((len(z), 1)), loss=loss, f_scale=3.0)
    for slopes in (False, True):
        found = evaluate(problem, theta[None], problem.starts[None], slopes=slopes)[0]
        assert found.cost == pytest.approx(asked.cost, rel=1e-5)


def test_evaluate__ignores_what_was_not_measured():
    problem = make_problem()
    holes = [
        replace(p, measured=np.where(np.arange(161)[:, None] % 3 == 0, np.nan, p.measured)) for p in problem.pieces
    ]
    theta = truth_of(problem) * 1.01
    found = evaluate(replace(problem, pieces=tuple(holes)), theta[None], problem.starts[None], slopes=True)[0]
    rows = brute_rows(replace(problem, pieces=tuple(holes)), theta, problem.starts)
    assert found.cost == pytest.approx(0.5 * np.nansum(rows**2), rel=1e-5)


@pytest.mark.slow
def test_fit_local__is_the_optimum_of_brute_force():
    """With noise: a step of Gauss and Newton by scipy's differences of all residuals leads nowhere from there."""
    problem = make_problem(NOISE)
    fit = fit_local(problem, problem.start)
    assert fit.converged
    jacobian = brute_jacobian(problem, fit.theta, fit.starts)
    step = np.linalg.lstsq(jacobian, brute_rows(problem, fit.theta, fit.starts), rcond=None)[0]
    deviation = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    assert np.max(np.abs(step) / deviation) < 1e-2
    # six deviations about the truth, which is some way from the guess
    assert np.max(np.abs(fit.theta - truth_of(problem)) / deviation[: len(fit.theta)]) < 6.0
    assert fit.rms[0] == pytest.approx(NOISE, rel=0.1)


@pytest.mark.slow
def test_fit_local__holds_what_is_fixed():
    problem = make_problem()
    truth = dict(zip(problem.names, truth_of(problem), strict=True))
    fit = fit_local(problem, truth_of(problem), fixed=truth)
    np.testing.assert_allclose(fit.theta, truth_of(problem))
    np.testing.assert_allclose(fit.starts, STARTS, atol=1e-6)
    some = fit_local(problem, problem.start, fixed={"cubic": 0.9, "zero.x": ZERO})
    assert some.theta[problem.names.index("cubic")] == 0.9
    assert some.cost > 100 * fit.cost


RATE = 2e-3
"""Rate at which the zero of the made sensor moves [1/s]."""


def drifting():
    """The problem with a zero that moves, in pieces that begin at 0, 10 and 20 s."""
    problem = make_problem(NOISE)
    pieces = [
        replace(p, begin_s=10.0 * k, measured=p.measured + RATE * (10.0 * k + p.time)[:, None])
        for k, p in enumerate(problem.pieces)
    ]
    return replace(problem, pieces=tuple(pieces))


def test_offsets__of_a_zero_that_drifts_follow_the_recordings_clock():
    problem = drifting()
    assert problem.offsets(problem.pieces[1]).shape == (1, 1, 5)
    both = replace(problem, free=(*problem.free, Free("zero.x.drift", 0.0, typical=0.01)))
    theta = np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.1])
    np.testing.assert_allclose((both.offsets(both.pieces[1]) @ theta)[:, 0], 0.5 + 0.1 * (10.0 + both.pieces[1].time))
    assert both.sloped == (0, 1, 2, 3)
    # what is held is taken from the measured values
    held = both.without({"zero.x": 0.5, "zero.x.drift": 0.1})
    gone = both.pieces[1].measured - held.pieces[1].measured
    np.testing.assert_allclose(gone[:, 0], 0.5 + 0.1 * (10.0 + both.pieces[1].time))
    # of several recordings each has its own
    own = replace(problem, free=(Free("zero.x.0", 0.0), Free("zero.x.0.drift", 0.0)))
    np.testing.assert_allclose(own.offsets(own.pieces[2])[:, 0, 1], 20.0 + own.pieces[2].time)


@pytest.mark.slow
def test_fit_local__a_zero_that_drifts_is_found_and_told():
    problem = drifting()
    without = fit_local(problem, problem.start)
    (told,) = drift_warnings(problem, without.residuals)
    assert 'sensors.drift = ["x"]' in told
    both = replace(problem, free=(*problem.free, Free("zero.x.drift", 0.0, typical=0.01)))
    fit = fit_local(both, both.start)
    assert fit.converged
    assert fit.theta[-1] == pytest.approx(RATE, rel=0.05)
    assert fit.rms[0] == pytest.approx(NOISE, rel=0.1)
    assert drift_warnings(both, fit.residuals) == []


def test_drift_warnings__noise_and_a_swing_are_no_drift():
    problem = drifting()
    noise = [np.random.default_rng(k).normal(size=(161, 1)) for k in range(3)]
    swing = [np.sin(3.0 * p.time)[:, None] for p in problem.pieces]
    for residuals in (noise, swing):
        assert drift_warnings(problem, residuals) == []
    moved = [n + 0.2 * (p.begin_s + p.time)[:, None] for n, p in zip(noise, problem.pieces, strict=True)]
    (told,) = drift_warnings(problem, moved)
    assert told.startswith("the residuals of x drift by +5.")
    assert "over 28 s" in told


def test_fit_starts__finds_each_start_by_itself():
    """One piece's guess is far off: the others do not wait for it, and it gets there."""
    problem = make_problem()
    guess = problem.starts.copy()
    guess[1] += [0.8, -1.5]
    found, settled = fit_starts(problem, truth_of(problem), guess)
    assert settled.all()
    np.testing.assert_allclose(found, STARTS, atol=1e-5)
    alone = replace(problem, pieces=problem.pieces[1:2])
    np.testing.assert_allclose(fit_starts(alone, truth_of(problem), guess[1:2]).starts[0], found[1], atol=1e-9)


@pytest.mark.slow
def test_fit_local__follows_ties_and_priors():
    tied = make_problem(free=("damping", "linear", "amplitude"), tied={"cubic": (0.8 / 3.0, "linear")})
    fit = fit_local(tied, tied.start)
    np.testing.assert_allclose(fit.theta, truth_of(tied), rtol=1e-5)
    values = tied.values(fit.theta)
    assert (values["cubic"], values["linear"]) == pytest.approx((0.8, 3.0), rel=1e-5)
    plain = make_problem(NOISE)
    free = tuple(replace(f, prior_mean=3.3, prior_sd=1e-7) if f.name == "linear" else f for f in plain.free)
    pinned = fit_local(replace(plain, free=free), plain.start)
    assert pinned.theta[1] == pytest.approx(3.3, abs=1e-4)


def test_fit_local__keeps_to_the_bounds():
    problem = make_problem()
    free = tuple(replace(f, lower=0.2, start=0.3) if f.name == "damping" else f for f in problem.free)
    fit = fit_local(replace(problem, free=free), np.array([f.start for f in free]))
    assert fit.theta[0] == pytest.approx(0.2, abs=1e-6)


def test_fit_local__says_that_it_has_not_converged():
    problem = make_problem()
    fit = fit_local(problem, problem.start * 0.5, max_evaluations=2)
    assert not fit.converged


def long_problem(weight):
    """One record as three stretches, each continuing the one before."""
    time = np.arange(321) * 0.05
    x = motion(TRUTH, STARTS[0], time)[:, :1] + ZERO
    x += 5 * NOISE * np.random.default_rng(8).normal(size=x.shape)
    bounds = [0, 100, 210, 321]
    pieces = []
    for k, (a, b) in enumerate(pairwise(bounds)):
        drive = Drive(np.full(9, 1 / FREQUENCY)).window(time[a], time[b - 1] + 0.05)
        start = [1.5, 0.0] if k == 0 else [x[a, 0] - ZERO, (x[a + 2, 0] - x[a - 2, 0]) / 0.2]
        pieces.append(Piece(0, 0, time[a:b] - time[a], x[a:b], np.array(start), drive, k - 1))
    unknowns = tuple(Free(n, 1.05 * TRUTH[n], 0.0, 10.0) for n in TRUTH)
    return Problem(
        MODEL, MODEL.load(**TRUTH), unknowns, ("x",), tuple(pieces), np.array([NOISE]), continuity=weight, rtol=1e-9
    )


@pytest.mark.slow
def test_fit_local__closes_the_gaps_as_their_weight_grows():
    gaps = []
    for weight in (0.01, 1.0, 100.0):
        problem = long_problem(weight)
        fit = fit_local(problem, problem.start)
        assert fit.converged
        ends = [
            motion(dict(zip(TRUTH, fit.theta, strict=True)), fit.starts[k], np.append(p.time, p.time[-1] + 0.05), t)[-1]
            for k, (p, t) in enumerate(zip(problem.pieces, (0.0, 5.0, 10.5), strict=True))
        ]
        gaps.append(max(np.abs(ends[k] - fit.starts[k + 1]).max() for k in range(2)))
    assert gaps[0] > 1.5 * gaps[1] > 100 * gaps[2], gaps
    assert gaps[2] < 1e-3


def test_cut__leaves_each_stretch_its_own_drive():
    """At the truth, with starts of their own, stretches fit as the whole does."""
    stretches = cut(make_problem(), 1.5)
    starts = fit_starts(stretches, truth_of(stretches), stretches.starts).starts
    found = evaluate(stretches, truth_of(stretches)[None], starts[None], slopes=False)[0]
    assert np.abs(np.concatenate(found.residuals)).max() < 1e-6


@pytest.mark.parametrize("at", ["lower", "upper"])
def test_evaluate__takes_slopes_within_the_bounds(at):
    """On a bound beyond which a model may not exist."""
    problem = make_problem()
    value = truth_of(problem)[0]
    bound = {at: value}
    free = (replace(problem.free[0], **bound), *problem.free[1:])
    steps = _steps(replace(problem, free=free), truth_of(problem)[None])[0]
    assert (steps[0] > 0) == (at == "lower")


def test_slowest_period__is_that_of_a_sine():
    time = np.arange(4001) * 0.01
    x = np.column_stack([np.sin(2 * np.pi * time / 1.7) + 0.3])
    problem = replace(make_problem(), pieces=(Piece(0, 0, time, x, np.zeros(2)),))
    assert slowest_period(problem) == pytest.approx(1.7, rel=0.05)


class Shelf:
    def __init__(self):
        self.fits, self.recalled = {}, []

    def recall(self, number):
        if number in self.fits:
            self.recalled.append(number)
        return self.fits.get(number)

    def store(self, number, fit):
        self.fits[number] = fit


@pytest.mark.slow
def test_search__ends_at_the_truth_from_guesses_far_off():
    problem, shelf = make_problem(NOISE), Shelf()
    arguments = {"n_starts": 6, "seed": 3, "spread": 0.3, "n_samples": 6}
    fits = search(problem, keep=shelf, **arguments)
    assert all(fit.converged for fit in fits)
    assert max(fit.cost for fit in fits) == pytest.approx(fits[0].cost, rel=1e-6)
    np.testing.assert_allclose(fits[0].theta, truth_of(problem), rtol=0.01)
    del shelf.fits[2]
    again = search(problem, keep=shelf, **arguments)
    assert sorted(shelf.recalled) == [0, 1, 3, 4, 5]
    np.testing.assert_array_equal([f.theta for f in again], [f.theta for f in fits])


@pytest.mark.slow  # needs cma
def test_search__finds_guesses_by_cma():
    """The local stage alone ends elsewhere."""
    problem = make_problem(NOISE)
    free = tuple(replace(f, start=7.0) if f.name == "linear" else f for f in problem.free)
    fits = search(replace(problem, free=free), n_starts=2, seed=1, spread=0.5, method="cma")
    np.testing.assert_allclose(fits[0].theta, truth_of(problem), rtol=0.01)


def test_sobol__keeps_to_spread_and_bounds():
    problem = make_problem()
    points = sobol(problem, 100, 5, 0.3)
    start = problem.start
    assert points.shape == (100, len(start))
    assert (np.abs(points - start) <= 0.3 * np.array([f.size for f in problem.free]) + 1e-12).all()
    assert (np.ptp(points, axis=0) > 0.5 * 0.6 * np.array([f.size for f in problem.free])).all()
    np.testing.assert_array_equal(points, sobol(problem, 100, 5, 0.3))
