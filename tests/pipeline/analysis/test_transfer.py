"""Transfer operators of maps whose spectra, committors and passage times follow by quadrature or on paper."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

import magpend
from pipeline.analysis.transfer.analysis import Pairs, _point, transfer_table
from pipeline.analysis.transfer.ulam import Grid, chain_of, closed_classes, committors, passage_times, stationary
from pipeline.products.transfer import TransferOptions

SIGMA = 0.18


def double_well(x: np.ndarray) -> np.ndarray:
    return x + 0.25 * (x - x**3)


def noisy_pairs(n_starts: int, n_steps: int) -> Pairs:
    rng = np.random.default_rng(0)
    paths = [rng.uniform(-1.7, 1.7, n_starts)]
    for _ in range(n_steps):
        paths.append(double_well(paths[-1]) + SIGMA * rng.standard_normal(n_starts))
    x = np.stack(paths, axis=1)
    unit = np.repeat(np.arange(n_starts), n_steps)
    return Pairs(x[:, :-1].reshape(-1, 1), x[:, 1:].reshape(-1, 1), unit)


@pytest.fixture(scope="module")
def well() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes, kernel times weights, and stationary density times weights, by Nystrom's method."""
    z, w = np.polynomial.legendre.leggauss(500)
    z, w = 2.6 * z, 2.6 * w
    kernel = norm.pdf(z[None, :], double_well(z)[:, None], SIGMA) * w[None, :]
    values, vectors = np.linalg.eig(kernel.T)
    pi = np.abs(vectors[:, np.argmax(values.real)].real)
    return z, kernel, pi / pi.sum()


def test_transfer__noisy_well_by_quadrature(well) -> None:
    z, kernel, pi = well
    found = _point(noisy_pairs(3000, 200), ["x"], [False], TransferOptions(bins=120, resamples=20))
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
    inner = np.eye(between.sum()) - kernel[np.ix_(between, between)]
    q[between] = np.linalg.solve(inner, kernel[np.ix_(between, there)].sum(axis=1))
    seen = (own == 1) & (np.abs(x) < 0.8)
    assert found["committor"][seen] == pytest.approx(np.interp(x[seen], z, q), abs=0.05)


def test_transfer__two_wells_without_noise_are_closed() -> None:
    x = np.random.default_rng(1).uniform(-1.7, 1.7, 60_000)
    paths = [x]
    for _ in range(8):
        paths.append(double_well(paths[-1]))
    y = np.stack(paths, axis=1)
    pairs = Pairs(y[:, :-1].reshape(-1, 1), y[:, 1:].reshape(-1, 1), np.repeat(np.arange(60_000), 8))
    found = _point(pairs, ["x"], [False], TransferOptions(bins=200, resamples=5))
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
