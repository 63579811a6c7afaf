"""Pairs, grids and slow sets of one parameter point, on chains that stand on paper."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from pipeline.analysis.noise.exits import PointCells
from pipeline.analysis.transfer import analysis
from pipeline.analysis.transfer.analysis import (
    Pairs,
    Sets,
    _core,
    _point,
    coarsened,
    grid_of,
    needs_pairs,
    numbers_of,
    pairs_of,
    sets_of_chain,
)
from pipeline.analysis.transfer.declaration import TransferOptions
from pipeline.analysis.transfer.ulam import OUTSIDE, Grid, chain_of
from pipeline.results.ragged import ROW_SIZE


def run_of(*, n_transient: int = 10, n_keep: int = 4, continuation: object = None) -> SimpleNamespace:
    """Return as much of a run as the choice of pairs asks for."""
    integration = SimpleNamespace(n_transient=n_transient, n_keep=n_keep)
    motion = SimpleNamespace(system=SimpleNamespace(section=None))
    spec = SimpleNamespace(continuation=continuation, integration=integration, motion=motion)
    return SimpleNamespace(model=SimpleNamespace(state_names=("x", "v")), spec=spec)


def blocks(coupling: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs with weights of nine boxes in three blocks, whose ends are coupled; all columns add to 1, too."""
    p = np.kron(np.eye(3), np.full((3, 3), 1.0 / 3.0))
    for a, b in ((2, 3), (5, 6)):
        for i, j in ((a, b), (b, a)):
            p[i, j] += coupling
            p[i, i] -= coupling
    before, after = np.nonzero(p)
    return before, after, p[before, after]


@pytest.mark.parametrize(
    ("run", "options", "words"),
    [
        (run_of(), {"states": "x,y"}, "unknown state 'y'; known: x, v"),
        (run_of(continuation=object()), {}, "needs a sweep"),
        (run_of(n_keep=1), {}, "leaves no pair"),
        (run_of(), {"low": {"x": 2.0}, "high": {"x": 1.0}}, "2 is not below 1"),
    ],
)
def test_needs_pairs__refuses(run, options, words) -> None:
    with pytest.raises(ValueError, match=words):
        needs_pairs(run, TransferOptions(**options))


def test_needs_pairs__takes_the_start_as_first_section_of_a_run_without_transient(monkeypatch) -> None:
    run, starts = run_of(n_transient=0, n_keep=1), np.array([[3.0, 4.0], [5.0, 6.0]])
    monkeypatch.setattr(analysis, "inputs_at", lambda *given: SimpleNamespace(initial_states=starts))
    needs_pairs(run, TransferOptions())  # the one section that is kept has a pair
    found = pairs_of(run, PointCells({}, {}, starts[:, None] - 2.0, np.zeros(2, int), np.ones(2, int)), [0, 1])
    np.testing.assert_array_equal(found.before, starts)
    np.testing.assert_array_equal(found.after, starts - 2.0)


def test_pairs_of__cells_that_diverged_count_in_their_first_step_only() -> None:
    section = np.arange(24.0).reshape(3, 4, 2)
    section[1, 2:] = np.nan  # no pair from the second section on, and its last step is not known
    section[2, 1:] = np.nan
    cells = PointCells({}, {}, section, np.zeros(3, int), np.array([4, 2, 1]))
    found = pairs_of(run_of(), cells, [0])
    np.testing.assert_array_equal(found.before[:, 0], [0, 2, 4, 8, 16])
    np.testing.assert_array_equal(found.after[:, 0], [2, 4, 6, 10, np.nan])
    # of three cells each is cut into 17 stretches, so that there are 50 units to draw from
    assert found.unit.max() < 3 * 17
    assert (np.diff(found.unit) > 0).all()


def test_grid_of__covers_all_states_or_what_is_asked_for() -> None:
    before = np.array([[0.0, -1.0], [4.0, 1.0], [2.0, 0.5]])
    pairs = Pairs(before, before + [1.0, 0.0], np.arange(3))
    free = grid_of(pairs, ["x", "th"], [False, True], TransferOptions())
    np.testing.assert_allclose(free.low, [0.0, -np.pi], atol=1e-7)
    np.testing.assert_allclose(free.high, [5.0, np.pi], atol=1e-7)
    assert free.bins.tolist() == [2, 2]
    assert (free.box_of(before) != OUTSIDE).all()
    asked = grid_of(pairs, ["x", "th"], [False, True], TransferOptions(bins=7, low={"x": 1.0}, high={"th": 0.7}))
    np.testing.assert_allclose(asked.low, [1.0, -1.0], atol=1e-7)
    np.testing.assert_allclose(asked.high, [5.0, 0.7], atol=1e-7)
    assert asked.bins.tolist() == [7, 7]
    # 25 pairs to a box of the plane: 10^4 pairs make 20 x 20
    many = np.random.default_rng(0).uniform(size=(10_000, 2))
    assert grid_of(Pairs(many, many, np.arange(10_000)), ["x", "v"], [False] * 2, TransferOptions()).bins.tolist() == [
        20,
        20,
    ]


def test_core__holds_the_share_in_its_densest_boxes() -> None:
    density = np.array([0.1, 0.4, 0.2, 0.3, 9.0])
    part = np.arange(4)
    assert _core(part, density, 0.7).tolist() == [1, 3]
    assert _core(part, density, 0.71).tolist() == [1, 2, 3]
    assert _core(part, density, 1.0).tolist() == [0, 1, 2, 3]


def test_sets_of_chain__almost_invariant_blocks() -> None:
    """Symmetric chains have an even measure; blocks at the ends keep 1 - coupling/3, that between 1 - 2 coupling/3."""
    coupling = 1e-3
    chain = chain_of(*blocks(coupling))
    found = sets_of_chain(chain, TransferOptions(sets=3, core=1.0))
    assert found.n_closed == 1
    assert found.of_box.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    np.testing.assert_allclose(found.density, 1.0 / 9.0)
    # three coupled places: the spectrum is that of a path, 1 - e, 1 - 3 e with e = coupling/3, up to e^2
    np.testing.assert_allclose(found.values[:3].real, 1.0 - np.array([0.0, 1.0, 3.0]) * coupling / 3.0, atol=2e-6)
    kept = numbers_of(chain.p, found)["kept"]
    np.testing.assert_allclose(kept, 1.0 - np.array([1.0, 2.0, 1.0]) * coupling / 3.0, rtol=1e-12)


def test_sets_of_chain__closed_blocks_are_sets_however_many_are_asked_for() -> None:
    chain = chain_of(*blocks(0.0))
    found = sets_of_chain(chain, TransferOptions(sets=2))
    assert found.n_closed == 3
    assert [core.tolist() for core in found.cores] == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    numbers = numbers_of(chain.p, found)
    np.testing.assert_allclose(numbers["kept"], 1.0)
    np.testing.assert_allclose(numbers["escape_rate"], 0.0, atol=1e-12)
    assert np.isinf(numbers["passage"][:3, :3][~np.eye(3, dtype=bool)]).all()


def test_sets_of_chain__paths_that_only_leave_make_no_set() -> None:
    chain = chain_of(np.array([0, 1, 2]), np.array([1, 2, OUTSIDE]))
    found = sets_of_chain(chain, TransferOptions())
    assert (found.cores, found.n_closed) == ([], 0)
    assert found.of_box.tolist() == [-1, -1, -1]


def test_numbers_of__a_leaky_set_escapes_at_its_eigenvalue() -> None:
    # both boxes keep 0.9 of what they have: rate -log 0.9, whatever goes on inside
    p = chain_of(np.repeat([0, 1], 3), np.array([0, 1, OUTSIDE] * 2), np.array([0.3, 0.6, 0.1, 0.8, 0.1, 0.1])).p
    sets = Sets(np.zeros(2, int), [np.arange(2)], np.array([0.5, 0.5]), 0, np.zeros(0), np.zeros(0, int))
    found = numbers_of(p, sets)
    assert found["escape_rate"][0] == pytest.approx(-np.log(0.9))
    assert found["kept"][0] == pytest.approx(0.9)


def test_coarsened__a_lumpable_chain_has_the_numbers_of_the_fine_one() -> None:
    """Boxes 2k and 2k + 1 have the same steps, so merging them loses nothing (Kemeny and Snell, 6.3)."""
    coarse = np.array([[0.9, 0.1, 0, 0], [0.2, 0.7, 0.1, 0], [0, 0.1, 0.7, 0.2], [0, 0, 0.2, 0.8]])
    before, after = np.nonzero(np.kron(coarse, np.ones((2, 2))))
    chain = chain_of(before, after, 0.5 * coarse[before // 2, after // 2])
    grid = Grid(np.zeros(1), np.ones(1), np.array([8]), np.array([False]))
    halves, none = np.repeat([0, 1], 4), np.zeros(0, int)
    sets = Sets(halves, [np.arange(2), np.arange(6, 8)], np.full(8, 0.125), 0, np.zeros(0), none)
    fine, merged = numbers_of(chain.p, sets), coarsened(chain, grid, sets)
    for name in ("escape_rate", "passage", "committor"):
        np.testing.assert_allclose(merged[name], fine[name], atol=1e-12)
    # from the second of four places the left end is reached first with the chance 8/11 of that on paper
    a = np.linalg.solve(np.eye(2) - coarse[1:3, 1:3], coarse[1:3, 0])
    np.testing.assert_allclose(fine["committor"][2:6, 0], np.repeat(a, 2))


def test_point__without_pairs_has_no_set() -> None:
    none = Pairs(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, int))
    found = _point(none, ["x", "v"], [False, False], TransferOptions())
    assert (found["n_pairs"], found["n_closed"], found[ROW_SIZE]) == (0, 0, 0)
    assert np.isnan(found["width"]).all()


def test_point__a_set_that_no_pair_leaves_has_the_bound_of_no_event() -> None:
    """Two points that map to themselves, 400 pairs each: the rate is below -log(0.05)/400 at the level 0.95."""
    x = np.repeat([-1.0, 1.0], 400)[:, None]
    pairs = Pairs(x, x.copy(), np.arange(800))
    found = _point(pairs, ["x"], [False], TransferOptions(bins=4, resamples=5, confidence=0.95))
    assert found["n_closed"] == 2
    np.testing.assert_allclose(found["escape_rate_high"], -np.log(0.05) / 400, rtol=1e-12)
    np.testing.assert_array_equal(found["escape_rate_low"], 0.0)
    np.testing.assert_allclose(found["share"], 0.5)
