"""Transfer operators of maps whose spectra, committors and passage times follow by quadrature or on paper."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

import magpend
from pipeline.analysis.transfer.analysis import Pairs, Sets, _point, numbers_of, transfer_table
from pipeline.analysis.transfer.declaration import TransferOptions
from pipeline.analysis.transfer.ulam import Grid, chain_of, closed_classes, committors, passage_times, stationary

SIGMA = 0.18


def double_well(x: np.ndarray) -> np.ndarray:
    return x + 0.25 * (x - x**3)


def pairs_along(x: np.ndarray) -> Pairs:
    """Pairs of successive states of paths (step, start, state), a unit for each."""
    n_steps, n_starts = len(x) - 1, x.shape[1]
    before, after = (own.swapaxes(0, 1).reshape(n_starts * n_steps, -1) for own in (x[:-1], x[1:]))
    return Pairs(before, after, np.repeat(np.arange(n_starts), n_steps))


def noisy_pairs(n_starts: int, n_steps: int) -> Pairs:
    rng = np.random.default_rng(0)
    paths = [rng.uniform(-1.7, 1.7, n_starts)]
    for _ in range(n_steps):
        paths.append(double_well(paths[-1]) + SIGMA * rng.standard_normal(n_starts))
    return pairs_along(np.array(paths)[..., None])


@pytest.fixture(scope="module")
def well() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes, kernel times weights, and stationary density times weights, by Nystrom's method."""
    z, w = np.polynomial.legendre.leggauss(500)
    z, w = 2.6 * z, 2.6 * w
    kernel = norm.pdf(z[None, :], double_well(z)[:, None], SIGMA) * w[None, :]
    values, vectors = np.linalg.eig(kernel.T)
    pi = np.abs(vectors[:, np.argmax(values.real)].real)
    return z, kernel, pi / pi.sum()


@pytest.mark.slow
def test_transfer__noisy_well_by_quadrature(well) -> None:
    z, kernel, pi = well
    pairs = noisy_pairs(3000, 200)
    found = _point(pairs, ["x"], [False], TransferOptions(bins=120, resamples=10))
    exact = np.sort(np.linalg.eigvals(kernel).real)[::-1]
    assert found["n_closed"] == 1
    assert found["eigenvalue"][1] == pytest.approx(exact[1], abs=3e-4)
    assert found["eigenvalue"][2] == pytest.approx(exact[2], abs=0.01)
    assert found["measure"] == pytest.approx([0.5, 0.5], abs=0.05)
    x, own = found["place"][:, 0], np.repeat([0, 1], found["n_points"])
    half = 0.5 * found["width"][0]
    assert x[own == 0].max() < 0.06
    assert x[own == 1].min() > -0.06  # the boundary is at 0
    left = z < 0.0
    rate = -np.log(np.linalg.eigvals(kernel[np.ix_(left, left)]).real.max())
    assert found["escape_rate"] == pytest.approx([rate, rate], rel=0.08)
    assert (found["escape_rate_low"] < found["escape_rate"]).all()
    assert (found["escape_rate_high"] > found["escape_rate"]).all()
    core = [x[(own == k) & (found["is_core"] > 0)] for k in (0, 1)]
    here, there = ((z > one.min() - half) & (z < one.max() + half) for one in core)
    free = ~there
    steps = np.zeros(len(z))
    steps[free] = np.linalg.solve(np.eye(free.sum()) - kernel[np.ix_(free, free)], np.ones(free.sum()))
    mean = pi[here] @ steps[here] / pi[here].sum()
    assert found["passage_low"][0, 1] < mean < found["passage_high"][0, 1]
    assert found["passage"][0, 1] == pytest.approx(mean, rel=0.08)
    between = ~here & ~there
    q = there.astype(float)
    visits = np.linalg.inv(np.eye(between.sum()) - kernel[np.ix_(between, between)])
    q[between] = visits @ kernel[np.ix_(between, there)].sum(axis=1)
    # a box of n pairs knows the mean of q one step on with the variance of q there over n; the error of a committor is
    # the sum over boxes, times the visits to them
    edges = np.concatenate([x[own == k] for k in (0, 1)])
    edges = np.append(np.sort(edges) - half, edges.max() + half)
    box = np.digitize(z[between], edges) - 1
    scatter = (kernel @ q**2 - (kernel @ q) ** 2)[between]
    by_box = np.stack([visits[:, box == k] @ np.sqrt(scatter[box == k]) for k in range(len(edges) - 1)], axis=1)
    error = np.sqrt(by_box**2 @ (1.0 / np.histogram(pairs.before, edges)[0]))
    seen = (own == 1) & (np.abs(x) < 0.8) & (found["is_core"] == 0)
    misfit = (found["committor"][seen] - np.interp(x[seen], z, q)) / np.interp(x[seen], z[between], error)
    assert np.sqrt(np.mean(misfit**2)) < 1.5
    assert np.abs(misfit).max() < 4.0
    width = found["committor_high"][seen] - found["committor_low"][seen]  # least and largest of 10 resamples
    assert np.median(width / np.interp(x[seen], z[between], error)) == pytest.approx(3.1, rel=0.3)


def whirl(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A map of the plane with two attracting points and no detailed balance."""
    return x + 0.3 * (x - x**3) + 0.25 * y, 0.6 * y - 0.1 * x


def noisy_whirl(rng: np.random.Generator, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    u, v = whirl(x, y)
    return u + 0.15 * rng.standard_normal(len(x)), v + 0.15 * rng.standard_normal(len(x))


@pytest.mark.slow
def test_transfer__committors_in_the_plane_by_simulation() -> None:
    rng = np.random.default_rng(5)
    paths = [(rng.uniform(-1.8, 1.8, 12_000), rng.uniform(-1.0, 1.0, 12_000))]
    for _ in range(25):
        paths.append(noisy_whirl(rng, *paths[-1]))
    pairs = pairs_along(np.array(paths).transpose(0, 2, 1))
    found = _point(pairs, ["x", "y"], [False, False], TransferOptions(bins=30, resamples=10))
    own = np.repeat([0, 1], found["n_points"])
    place, width = found["place"], found["width"]
    q = np.where(own == 1, found["committor"], 1.0 - found["committor"])
    corner = place.min(axis=0)
    core_at = np.full((48, 48), -1)
    core_at[tuple(np.rint((place - corner) / width).astype(int).T)] = np.where(found["is_core"] > 0, own, -1)
    boxes = np.random.default_rng(6).choice(np.flatnonzero((q > 0.1) & (q < 0.9) & (found["density"] > 1e-3)), 12)
    n = 4000
    x, y = (place[np.repeat(boxes, n)] + rng.uniform(-0.5, 0.5, (12 * n, 2)) * width).T
    end = np.full(12 * n, -1)
    for _ in range(3000):
        going = np.flatnonzero(end < 0)
        if not len(going):
            break
        x[going], y[going] = noisy_whirl(rng, x[going], y[going])
        at = np.floor((np.column_stack([x, y])[going] - corner) / width + 0.5).astype(int)
        end[going] = np.where(((at >= 0) & (at < 48)).all(axis=1), core_at[tuple(np.clip(at, 0, 47).T)], -1)
    assert (end >= 0).all()
    counted = end.reshape(12, n).mean(axis=1)
    counting = (found["committor_high"] - found["committor_low"])[boxes] / 3.1  # least and largest of 10
    cell = np.abs(found["committor"] - found["committor_coarse"])[boxes]
    allowed = 3.0 * np.hypot(np.sqrt(counted * (1.0 - counted) / n), counting) + cell
    assert (np.abs(counted - q[boxes]) < allowed).all()
    assert allowed.max() < 0.1


def test_transfer__two_wells_without_noise_are_closed() -> None:
    x = np.random.default_rng(1).uniform(-1.7, 1.7, 60_000)
    paths = [x]
    for _ in range(8):
        paths.append(double_well(paths[-1]))
    found = _point(pairs_along(np.array(paths)[..., None]), ["x"], [False], TransferOptions(bins=200, resamples=5))
    assert found["n_closed"] == 2
    assert found["escape_rate"] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert (found["escape_rate_high"] > 0.0).all()
    assert np.isinf(found["passage"][0, 1])
    own = np.repeat([0, 1], found["n_points"])
    sure = np.abs(found["place"][:, 0]) > 0.05
    # x = 0 divides the basins
    assert (np.sign(found["place"][sure, 0]) == np.where(own[sure] == 0, -1.0, 1.0)).all()
    assert found["committor"][sure] == pytest.approx(1.0, abs=1e-6)


def test_transfer__escape_from_a_tent_with_a_gap() -> None:
    # slope 3 maps two of three thirds onto [0, 1]: a third of the even measure leaves in each step
    x = np.random.default_rng(2).uniform(0.0, 1.0, 300_000)
    y = np.where(x < 0.5, 3.0 * x, 3.0 * (1.0 - x))
    pairs = Pairs(x[:, None], y[:, None], np.arange(len(x)) // 1000)
    options = TransferOptions(bins=81, low={"x": 0.0}, high={"x": 1.0}, sets=1, resamples=20)
    found = _point(pairs, ["x"], [False], options)
    assert found["escape_rate"][0] == pytest.approx(np.log(1.5), abs=0.01)
    assert found["escape_rate_low"][0] < np.log(1.5) < found["escape_rate_high"][0]
    assert found["outside"] == pytest.approx(1.0 / 3.0, abs=0.01)


def test_chain__gambler_on_paper() -> None:
    # a fair walk on 0 ... 6: the committor to 6 is linear; from i the mean time to either end is i (6 - i)
    before = np.repeat(np.arange(7), 2)
    after = np.array([0, 0, 0, 2, 1, 3, 2, 4, 3, 5, 4, 6, 6, 6])
    p = chain_of(before, after).p
    assert sorted(own.tolist() for own in closed_classes(p)) == [[0], [6]]
    ends = [np.array([0]), np.array([6])]
    assert committors(p, ends)[:, 1] == pytest.approx(np.arange(7) / 6.0)
    assert passage_times(p, np.array([0, 6])) == pytest.approx([i * (6 - i) for i in range(7)])
    assert np.isinf(passage_times(p, ends[1])[:6]).all()  # each of them can end at 0
    loop = chain_of(np.array([0, 0, 1, 2]), np.array([0, 1, 2, 0])).p
    assert stationary(loop) == pytest.approx([0.5, 0.25, 0.25])


def test_numbers_of__passages_are_weighed_by_the_measure_of_the_core() -> None:
    # a walk on 0 ... 6 that turns back at its ends: from i to 6 it takes 36 - i**2 steps, and the ends have half the
    # measure of other places
    before, after = np.repeat(np.arange(7), 2), np.array([1, 1, 0, 2, 1, 3, 2, 4, 3, 5, 4, 6, 5, 5])
    p = chain_of(before, after).p
    density = stationary(p)
    assert density == pytest.approx(np.array([1, 2, 2, 2, 2, 2, 1]) / 12.0)
    cores = [np.array([0, 1]), np.array([6])]
    halves, none = np.array([0, 0, 0, 0, 1, 1, 1]), np.zeros(0, int)
    found = numbers_of(p, Sets(halves, cores, density, 0, np.zeros(0), none))
    assert found["passage"][0, 1] == pytest.approx((36.0 + 2.0 * 35.0) / 3.0)
    assert found["passage"][1, 0] == pytest.approx(25.0)
    assert found["kept"] == pytest.approx([6.0 / 7.0, 4.0 / 5.0])


def test_grid__angles_turn_and_bounds_count() -> None:
    grid = Grid(np.array([-np.pi, 0.0]), np.array([np.pi, 1.0]), np.array([4, 2]), np.array([True, False]))
    states = np.array([[-3.0, 0.1], [2.0 * np.pi - 3.0, 0.1], [0.1, 1.0], [0.1, 1.1], [np.nan, 0.5]])
    assert grid.box_of(states).tolist() == [0, 0, 5, -1, -1]


NOISY = """
kind = "sweep"
[model]
name = "wells"
states = { x = { meaning = "position" }, v = { meaning = "velocity" } }
parameters = { d = 0.15, A = 0.2 }
equations = { x = "v", v = "x - x**3 - d*v + A*cos(2*pi*f*t)" }
[noise]
strengths = { v = 0.05 }
seed = 1
steps_per_period = 128
[parameters]
omega = 1.0
[axes]
noise_v = { values = [0.05, 0.06] }
[initial_conditions]
kind = "random"
n = 150
seed = 1
x = [-1.8, 1.8]
v = [-1.0, 1.0]
[integration]
n_transient = 0
n_keep = 1000
"""


@pytest.mark.slow
def test_transfer__noisy_run_against_its_own_passages(tmp_path) -> None:
    (tmp_path / "wells.toml").write_text(NOISY)
    run = magpend.run(tmp_path / "wells.toml", tmp_path / "run", workers=0)
    found = run.transfer(bins=40, resamples=20)
    lines = transfer_table(found).lines
    assert "2 almost invariant sets" in lines[0]
    cube = run.cube()
    for i in (0, 1):
        # first passages counted in the cells themselves, from one core to the other
        rows = slice(*np.cumsum([0, *found["n_sets"].values])[i : i + 2])
        sizes, first = found["n_points"].values[rows], int(found["n_points"].values[: rows.start].sum())
        width = found["width"].values[i]
        part = slice(first, first + int(sizes.sum()))
        place, core = found["place"].values[part], found["is_core"].values[part] > 0
        own = np.repeat([0, 1], sizes)
        section = cube["section"].isel(noise_v=i).values
        low = place.min(axis=0)
        code = np.full(section.shape[:2], -1)
        cells = np.rint((section - low) / width).astype(int)
        table = {tuple(np.rint((p - low) / width).astype(int)): k for p, k in zip(place[core], own[core], strict=True)}
        for index in np.ndindex(*code.shape):
            code[index] = table.get(tuple(cells[index]), -1)
        counted = [_passages(code, k) for k in (0, 1)]
        for k, other in ((0, 1), (1, 0)):
            steps, n = counted[k]
            assert found["passage"].values[rows][k, other] == pytest.approx(steps, rel=4.0 / np.sqrt(n) + 0.05)


def _passages(code: np.ndarray, k: int) -> tuple[float, int]:
    """Return time at risk over passages from core k to the other core, and the number of passages."""
    at_risk = n = 0
    for row in code:
        last = -1
        for one in row:
            at_risk += last == k
            n += last == k and one == 1 - k
            last = one if one >= 0 else last
    return at_risk / n, n
