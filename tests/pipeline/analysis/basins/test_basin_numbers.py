"""Numbers on basins against values known on paper, published values, and simulated truth."""

import numpy as np
import pytest
import xarray as xr
from scipy import stats
from scipy.spatial.distance import cdist

from pipeline.analysis.basins.labels import read_labels
from pipeline.analysis.basins.numbers import (
    basin_entropy,
    basin_rows,
    binomial_interval,
    uncertainty_exponent,
    wada_merge_test,
)

METHODS = ["wilson", "clopper-pearson"]


def cubic_map(x, threshold=1.0):
    """Where x -> x^3/threshold^2 ends: 0 at the fixed point 0, 1 and 2 at plus and minus infinity.

    On paper: the unstable fixed points -threshold and threshold part the basins.
    """
    for _ in range(60):
        x = np.clip(x**3 / threshold**2, -1e9, 1e9)
    return np.where(np.abs(x) < 1.0e-3, 0, np.where(x > 0, 1, 2))


def grebogi_map(n=300):
    """Basins of the two fixed points of the map of Grebogi et al. (a = 1.32, b = 0.9, J0 = 0.3)."""
    theta, x = np.meshgrid(np.linspace(0, 2 * np.pi, n), np.linspace(-0.5, 0.5, n), indexing="ij")
    for _ in range(300):
        kick = 1.32 * np.sin(2 * theta) - 0.9 * np.sin(4 * theta) - x * np.sin(theta)
        theta, x = np.mod(theta + kick, 2 * np.pi), -0.3 * np.cos(theta)
    return np.where(np.abs(np.sin(theta)) > 1e-6, -1, np.cos(theta) < 0)


def newton_basins(n=300):
    """Basins of Newton's method on z^3 - 1 over [-1, 1]^2."""
    x = np.linspace(-1, 1, n)
    z = x[:, None] + 1j * x
    for _ in range(60):
        z = z - (z**3 - 1) / (3 * z**2)
    distance = np.abs(z[..., None] - np.exp(2j * np.pi * np.arange(3) / 3))
    return np.where(distance.min(axis=-1) < 1e-6, distance.argmin(axis=-1), -1)


def cantor_basins(levels=8):
    """A line whose basin boundary is the middle-third Cantor set: gaps in turn, by level, 0 and 1."""
    labels = np.full(3**levels, 2)
    for level in range(levels):
        width = 3 ** (levels - level)
        thirds = labels.reshape(-1, 3, width // 3)
        whole = (thirds == 2).all(axis=(1, 2))
        thirds[whole, 1] = level % 2
    return labels


# --- fractions -------------------------------------------------------------------------------------------


def fractions(labels, dims=(), inferred=None, method="wilson"):
    """Basin fractions of labels, whose first dims are the parameters."""
    labels = xr.DataArray(labels)
    inferred = xr.zeros_like(labels, bool) if inferred is None else inferred
    return basin_rows(labels, dims, inferred, 0.95, method)


def test_basin_rows__counts():
    ds = fractions([[1, 2, 2], [-3, 2, -1]])
    assert ds["attractor"].values.tolist() == [-3, 1, 2]
    assert ds["count"].values.tolist() == [1, 1, 3]
    np.testing.assert_allclose(ds["fraction"], [1 / 6, 1 / 6, 3 / 6])
    assert (ds["n_cells"].item(), ds["n_unfinished"].item()) == (6, 1)
    assert ds["fraction_unfinished"].item() == pytest.approx(1 / 6)
    np.testing.assert_allclose(ds["fraction_if_all"], [2 / 6, 2 / 6, 4 / 6])
    bound = fractions(np.zeros(1000, dtype=int))["unseen_high"].item()
    assert (1 - bound) ** 1000 == pytest.approx(0.05)
    assert bound == pytest.approx(3 / 1000, rel=0.01)
    half = fractions(np.repeat([0, -1], 500))
    assert half["unseen_high"].item() == pytest.approx(3 / 500, rel=0.01)
    # all 500 unfinished cells may have gone to one that was not seen
    assert 0.5 < half["unseen_high_if_all"].item() < 0.53


@pytest.mark.parametrize(("method", "expected"), [("wilson", "wilson"), ("clopper-pearson", "exact")])
def test_binomial_interval__agrees_with_scipy(method, expected):
    for k in range(21):
        reference = stats.binomtest(k, 20).proportion_ci(0.9, method=expected)
        low, high = binomial_interval(k, 20, confidence=0.9, method=method)
        np.testing.assert_allclose([low, high], [reference.low, reference.high], atol=1e-12)


def rows_of(ds, outcome):
    """Rows of an outcome, and the parameter points that have none."""
    points = np.repeat(np.arange(ds["n_sets"].size), ds["n_sets"].values)
    own = ds["attractor"].values == outcome
    return ds.isel(set=own), np.setdiff1d(np.arange(ds["n_sets"].size), points[own])


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_basin_rows__simulated_coverage(method):
    # starts in [-1.04, 2]; basins (-1, 1), (1, 2], [-1.04, -1) on paper
    rng = np.random.default_rng(7)
    labels = cubic_map(rng.uniform(-1.04, 2.0, (2000, 150)))
    ds = fractions(xr.DataArray(labels, dims=("run", "start")), ["run"], method=method)
    for outcome, truth in enumerate(np.array([2.0, 1.0, 0.04]) / 3.04):
        own, absent = rows_of(ds, outcome)
        assert float(own["fraction"].sum()) / 2000 == pytest.approx(truth, abs=0.003)
        # where no cell shows an outcome, the bound for one that was not seen holds
        bounded = ds["unseen_high"].values[absent] >= truth
        rate = (((own["low"] <= truth) & (truth <= own["high"])).sum().item() + bounded.sum()) / 2000
        # one standard error of a rate is 0.005; Wilson's rate swings about the level with p and n
        assert rate > (0.92 if method == "wilson" else 0.94)
        assert rate < 0.975 or outcome == 2
        # a sixth of the runs do not see the rarest basin at all, and still do not call it absent
        assert len(absent) / 2000 > 0.1 or outcome < 2


def test_basin_rows__unfinished_cells_that_are_not_like_the_rest():
    rng = np.random.default_rng(8)
    labels = cubic_map(rng.uniform(-1.5, 1.5, (1000, 150)))
    labels[labels == 2] = -1  # one basin is slow: none of its cells finished
    ds = fractions(xr.DataArray(labels, dims=("run", "start")), ["run"], method="clopper-pearson")
    for outcome, truth in ((0, 4 / 6), (1, 1 / 6)):
        own, absent = rows_of(ds, outcome)
        assert not len(absent)
        assert ((own["low"] <= truth) & (truth <= own["high_if_all"])).mean() > 0.94
    assert (ds["unseen_high_if_all"] >= 1 / 6).mean() > 0.92


def test_basin_rows__along_a_sweep():
    labels = xr.DataArray([[[0, 0], [1, -1]], [[-1, -1], [-1, -1]]], dims=("frequency", "y", "x"))
    ds = fractions(labels, ["frequency"])
    np.testing.assert_allclose(ds["fraction"], [2 / 4, 1 / 4])
    assert ds["n_sets"].values.tolist() == [2, 0]
    assert ds["fraction_unfinished"].values.tolist() == [0.25, 1.0]
    assert ds["unseen_high"].values[1] == 1.0


def test_basin_rows__inferred_cells_count_and_are_told():
    rng = np.random.default_rng(5)
    labels = xr.DataArray(rng.integers(-1, 3, (2, 30, 20)), dims=["frequency", "x", "y"])
    inferred = xr.DataArray(rng.random((2, 30, 20)) < 0.4, dims=["frequency", "x", "y"])
    ds, plain = fractions(labels, ["frequency"], inferred), fractions(labels, ["frequency"])
    assert ds.drop_vars("n_inferred").identical(plain.drop_vars("n_inferred"))
    points = np.repeat([0, 1], ds["n_sets"].values)
    for row, (f, label) in enumerate(zip(points, ds["attractor"].values, strict=True)):
        assert ds["n_inferred"][row] == ((labels[f] == label) & inferred[f]).sum()


# --- entropy ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_basin_entropy__grebogi_map():
    # Attractors.jl, test/basins/uncertainty_tests.jl: 0.40-0.42 and 0.60-0.61 at this resolution
    ds = basin_entropy(grebogi_map(), 6)
    assert ds["fraction_unfinished"].item() == 0.0
    assert 0.40 <= ds["entropy"].item() <= 0.42
    assert 0.60 <= ds["boundary_entropy"].item() <= 0.61
    assert not ds["above_ln2"].item()  # two labels cannot exceed it


def test_basin_entropy__on_paper():
    labels = np.zeros((6, 5), dtype=int)
    labels[0, 0] = 1  # one box of 2 x 2 with a quarter
    labels[2:4, 1] = 2  # one half and half
    ds = basin_entropy(labels, 2)
    quarter = 0.25 * np.log(4) + 0.75 * np.log(4 / 3)
    # the box has 5 x 4 places: the corner is in one box, the pair in two whole and four half
    assert ds["entropy"].item() == pytest.approx((quarter + 2 * np.log(2) + 4 * quarter) / 20)
    assert ds["boundary_entropy"].item() == pytest.approx((quarter + np.log(2)) / 2)
    assert (ds["n_boxes"].item(), ds["n_boundary_boxes"].item(), ds["n_labels"].item()) == (6, 2, 3)
    assert ds["fraction_used"].item() == pytest.approx(24 / 30)
    labels = np.zeros((9, 8, 12), dtype=int)
    labels[:5] = 1
    labels[:, :, ::2] += 10
    ds = basin_entropy(labels, (3, 2, 1))
    # boxes of one plane: a third against two thirds in the middle layer
    mixed = np.log(3) - 2 / 3 * np.log(2)
    # of the seven places along the first axis two are mixed
    assert ds["entropy"].item() == pytest.approx(2 * mixed / 7)
    assert ds["boundary_entropy"].item() == pytest.approx(mixed)
    labels = np.zeros((4, 4), dtype=int)
    labels[0, 0], labels[0, 1], labels[2:, 2:] = 1, -1, -1
    ds = basin_entropy(labels, 2)
    third = np.log(3) - 2 / 3 * np.log(2)
    # the first box has one of three cells, its lower neighbour none; the box in the last corner has none known
    assert ds["entropy"].item() == pytest.approx(third / 8)
    assert ds["n_boxes"].item() == 3
    assert ds["fraction_unfinished"].item() == 5 / 16
    assert basin_entropy(labels, 2, unfinished=())["n_labels"].item() == 3
    rng = np.random.default_rng(0)
    three = basin_entropy(rng.integers(3, size=(60, 60)))
    assert three["boundary_entropy"].item() > 1.0
    assert three["above_ln2"].item()
    assert three["above_ln2_surely"].item()
    two = basin_entropy(rng.integers(2, size=(60, 60)))
    assert not two["above_ln2"].item()
    # Three labels in one box exceed ln 2, and one box proves nothing
    one = np.arange(25).reshape(5, 5) % 3
    found = basin_entropy(one, 5)
    assert found["above_ln2"]
    assert not found["above_ln2_surely"]
    assert np.isnan([found[f"{name}_stderr"] for name in ("entropy", "boundary_entropy")]).all()
    # twenty boxes, four of them on the boundary
    four = np.zeros((100, 5), int)
    four[:20] = np.tile(one, (4, 1))
    found = basin_entropy(four, 5)
    assert np.isfinite(found["entropy_stderr"])
    assert np.isnan(found["boundary_entropy_low"])
    assert not found["above_ln2_surely"]
    many = basin_entropy(np.tile(one, (8, 1)), 5)
    assert many["above_ln2_surely"]


@pytest.mark.parametrize("at", [(10, 10), (11, 10), (12, 13)])
def test_basin_entropy__borders_between_boxes(at):
    # four basins with straight borders; boxes of 5 side by side see none of them at (10, 10)
    x = np.arange(20)
    labels = 2 * (x[:, None] >= at[0]) + (x >= at[1])
    ds = basin_entropy(labels, 5)
    boxes = np.lib.stride_tricks.sliding_window_view(labels, (5, 5)).reshape(-1, 25)
    entropy = [stats.entropy(np.unique(box, return_counts=True)[1]) for box in boxes]
    assert ds["entropy"].item() == pytest.approx(np.mean(entropy), rel=1e-12)
    assert ds["entropy_low"] < ds["entropy"] < ds["entropy_high"]
    assert ds["entropy_stderr"] > 0.0
    # from the first cell on as published; where those see no border, the mean over all places
    tiles = labels.reshape(4, 5, 4, 5).transpose(0, 2, 1, 3).reshape(-1, 25)
    tiled = [stats.entropy(np.unique(box, return_counts=True)[1]) for box in tiles]
    boundary = np.array(tiled if max(tiled) > 0.0 else entropy)
    assert ds["boundary_entropy"].item() == pytest.approx(boundary[boundary > 0.0].mean(), rel=1e-12)
    assert ds["boundary_entropy_low"] < ds["boundary_entropy"] < ds["boundary_entropy_high"]


@pytest.mark.slow
@pytest.mark.parametrize(("patch", "block", "low", "high"), [(1, 1, 0.8, 1.25), (4, 4, 0.8, 1.25), (4, 1, 0.1, 0.45)])
def test_basin_entropy__bootstrap_tells_the_scatter(patch, block, low, high):
    # patches of boxes are mixed or not by a coin: the scatter over many such grids is the true error
    rng = np.random.default_rng(5)
    values, errors = [], []
    for _ in range(150):
        side = 3 * patch
        mixed = np.kron(rng.random((60 // side, 60 // side)) < 0.5, np.ones((side, side), dtype=int))
        ds = basin_entropy(mixed * rng.integers(2, size=(60, 60)), 3, block=block, resamples=60)
        values.append(ds["entropy"].item())
        errors.append(ds["entropy_stderr"].item())
    assert low < np.mean(errors) / np.std(values) < high


def test_boundaries__names_of_labels_do_not_matter():
    labels = newton_basins(120)
    renamed = np.array([40, -7, 3])[labels]
    for function in (basin_entropy, uncertainty_exponent, wada_merge_test):
        one, other = function(labels), function(renamed)
        for name in ("entropy", "entropy_stderr", "exponent", "exponent_stderr", "hausdorff_distance", "beyond_stderr"):
            if name in one:
                np.testing.assert_allclose(one[name], other[name], rtol=1e-12)


# --- uncertainty exponent --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "epsilons"), [("perturbation", None), ("perturbation", range(1, 31)), ("boxes", range(5, 31))]
)
def test_uncertainty_exponent__newton(method, epsilons):
    # Attractors.jl, test/basins/uncertainty_tests.jl: 0.55-0.65 by boxes of 5 to 30 cells on 300 x 300
    ds = uncertainty_exponent(newton_basins(), method=method, epsilons=epsilons)
    assert 0.55 <= ds["exponent"].item() <= 0.65
    assert ds["boundary_dimension"].item() == pytest.approx(2 - ds["exponent"].item())
    assert ds["exponent_low"].item() < ds["exponent"].item() < ds["exponent_high"].item()
    assert 0.01 < ds["exponent_stderr"].item() < 0.06


@pytest.mark.slow
def test_uncertainty_exponent__grebogi_map():
    # the same file, 251 x 251, boxes of 3 to 15: 0.2-0.3, roughly 0.2 in the paper
    ds = uncertainty_exponent(grebogi_map(251), method="boxes", epsilons=range(3, 16))
    assert 0.2 <= ds["exponent"].item() <= 0.3


def test_uncertainty_exponent__of_a_cantor_set_and_of_a_diagonal():
    # boxes that are the intervals of the construction: 2^level of 3^level see more than one basin
    ds = uncertainty_exponent(cantor_basins(), method="boxes", epsilons=[3**k for k in range(1, 8)])
    assert ds["exponent"].item() == pytest.approx(1 - np.log(2) / np.log(3), abs=1e-12)
    np.testing.assert_allclose(ds["uncertain"], (2 / 3) ** np.arange(7, 0, -1))
    np.testing.assert_allclose(ds["fitted"], ds["uncertain"])
    assert ds["exponent_stderr_fit"].item() < 1e-12
    assert ds["exponent_stderr"].item() > 0.005
    i = np.arange(400)
    ds = uncertainty_exponent((i[:, None] + i < 400).astype(int), method="entropy", epsilons=[8, 10, 20, 40, 50])
    # only the boxes on the diagonal are mixed, each about half and half
    assert ds["exponent"].item() == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(ds["uncertain"] * 400 / ds["epsilon"], np.log(2), rtol=0.02)


@pytest.mark.parametrize("dims", [1, 2, 3])
def test_uncertainty_exponent__plane_boundary_is_exact(dims):
    side = {1: 400, 2: 200, 3: 60}[dims]
    labels = np.zeros((side,) * dims, dtype=int)
    labels[side // 2 :] = 1
    ds = uncertainty_exponent(labels)
    assert ds["exponent"].item() == pytest.approx(1.0, abs=1e-12)
    room = side - 2 * ds["epsilon"].values[-1]
    np.testing.assert_allclose(ds["uncertain"], 2 * ds["epsilon"] / room / dims)


def test_uncertainty_exponent__of_empty_boxes_unfinished_cells_and_one_basin():
    labels = np.repeat([0, 1], 1200)  # sides of 4, 5 and 6 meet the boundary with an edge
    ds = uncertainty_exponent(labels, method="boxes", epsilons=[4, 5, 6, 7, 11, 16, 17])
    assert ds["used"].values.tolist() == [False, False, False, True, True, False, True]
    np.testing.assert_allclose(ds["uncertain"].values[[3, 4, 6]], [1 / 342, 1 / 218, 1 / 141])
    slope = np.polyfit(np.log([7, 11, 17]), np.log([1 / 342, 1 / 218, 1 / 141]), 1)[0]
    assert ds["exponent"].item() == pytest.approx(slope)
    labels = np.zeros((200, 200), dtype=int)
    labels[100:] = 1
    spoilt = labels.copy()
    spoilt[::7, ::5] = -1
    ds = uncertainty_exponent(spoilt)
    assert ds["exponent"].item() == pytest.approx(1.0, abs=0.05)
    assert ds["fraction_unfinished"].item() > 0.02
    assert uncertainty_exponent(spoilt, unfinished=())["exponent"].item() < 0.7
    labels = np.full((50, 50), 4)
    for method in ("perturbation", "boxes", "entropy"):
        ds = uncertainty_exponent(labels, method=method)
        assert np.isnan(ds["exponent"].item())
        assert not ds["used"].any()
    ds = basin_entropy(labels)
    assert ds["entropy"].item() == 0.0
    assert np.isnan(ds["boundary_entropy"].item())
    assert not ds["above_ln2"].item()


@pytest.mark.slow
def test_uncertainty_exponent__bootstrap_tells_the_scatter():
    # smooth random boundaries: many discs thrown at the square
    rng = np.random.default_rng(4)
    x = np.arange(120)
    values, errors = [], []
    for _ in range(60):
        centre, radius = rng.uniform(0, 120, (2, 12, 1, 1)), rng.uniform(4, 14, (12, 1, 1))
        inside = ((x[:, None] - centre[0]) ** 2 + (x - centre[1]) ** 2 < radius**2).any(axis=0)
        ds = uncertainty_exponent(inside.astype(int), epsilons=[1, 2, 3, 4, 6], resamples=60)
        values.append(ds["exponent"].item())
        errors.append(ds["exponent_stderr"].item())
    assert 0.9 < np.mean(values) < 1.05
    assert 0.6 < np.mean(errors) / np.std(values) < 1.5


# --- Wada ------------------------------------------------------------------------------------------------


def test_wada_merge_test__published_toy_cases():
    # Attractors.jl, test/basins/wada_tests.jl: 12 x 12, smooth and artificially fractal
    smooth = np.repeat([1, 2, 3], 4)[:, None] * np.ones(12, dtype=int)
    ds = wada_merge_test(smooth, [1, 2])
    np.testing.assert_allclose(ds["beyond"], 12 * 2 / 12**2)
    assert not ds["wada"].any()
    fractal = np.tile([1, 2, 3], 4)[:, None] * np.ones(12, dtype=int)
    ds = wada_merge_test(fractal, 1)
    assert ds["beyond"].item() == 0.0
    assert ds["wada"].all()
    labels = np.repeat([0, 1, -1, 2], 5)[:, None] * np.ones(8, dtype=int)
    ds = wada_merge_test(labels, 50)
    assert np.isinf(ds["hausdorff_distance"].item())
    assert not ds["wada"].item()
    assert ds["n_boundary"].values.tolist() == [16, 16, 0]
    assert ds["beyond"].item() == 0.1
    assert ds["fraction_unfinished"].item() == 0.25


def test_wada_merge_test__newton_is_wada():
    ds = wada_merge_test(newton_basins(), [1, 3, 6])
    assert ds["wada"].values.tolist() == [False, False, True]
    assert ds["hausdorff_distance"].item() <= 6
    assert 0 < ds["beyond"].values[1] < ds["beyond"].values[0] < 0.01
    assert np.all(ds["beyond_stderr"].values[:2] > 0)
    assert ds["beyond_low"].values[0] < ds["beyond"].values[0] < ds["beyond_high"].values[0]
    # two of three basins finely mixed, the third apart behind a straight line
    labels = np.random.default_rng(0).integers(2, size=(60, 60))
    labels[40:] = 2
    ds = wada_merge_test(labels, 5)
    assert not ds["wada"].item()
    assert ds["distance"].sel(label=0, other=2).item() == 39
    assert ds["distance"].sel(label=2, other=0).item() < 5
    assert ds["beyond"].item() == pytest.approx(34 / 60, abs=0.05)
    assert ds["beyond_of_boundary"].item() > 0.8


@pytest.mark.parametrize(("metric", "name"), [("taxicab", "cityblock"), ("chessboard", "chebyshev")])
@pytest.mark.parametrize("shape", [(14, 11), (7, 6, 5)])
def test_wada_merge_test__agrees_with_all_pairs(metric, name, shape):
    rng = np.random.default_rng(9)
    # blobs, so that the boundaries differ
    labels = np.argmax([np.cumsum(rng.normal(size=shape), axis=0) for _ in range(3)], axis=0)
    ds = wada_merge_test(labels, 1, metric=metric)
    edges = []
    for k in range(3):
        padded = np.pad(labels == k, 1, mode="edge")
        inner = (slice(1, -1),) * len(shape)
        rolled = [np.roll(padded, s, a)[inner] for a in range(len(shape)) for s in (-1, 1)]
        edges.append(np.argwhere(np.any(np.array(rolled) != (labels == k), axis=0)))
    assert ds["n_boundary"].values.tolist() == [len(edge) for edge in edges]
    far = [[cdist(a, b, name).min(axis=1) for b in edges] for a in edges]
    np.testing.assert_array_equal(ds["distance"], [[d.max() for d in row] for row in far])
    most = max((d > 1).sum() for row in far for d in row)
    assert ds["beyond"].item() == pytest.approx(most / labels.size)


ONE, THREE = np.zeros((50, 50), int), [[0, 1], [2, 0]]


@pytest.mark.parametrize(
    ("function", "arguments", "message"),
    [
        (read_labels, ([0.0, 1.0], ()), r"float64.*integer code"),
        (read_labels, (np.zeros((0, 3), int), ()), "no cells"),
        (read_labels, (4, ()), "no cells"),
        (binomial_interval, (0, 1, {"confidence": 95}), "confidence is 95"),
        (binomial_interval, (0, 1, {"method": "wald"}), "'wald'"),
        (binomial_interval, (5, 4), "not within 0 and n"),
        (basin_entropy, (ONE, 1), "2 cells"),
        (basin_entropy, (ONE, 51), r"larger than the grid \(50, 50\)"),
        (basin_entropy, (ONE, (2, 2, 2)), "3 sides, the grid 2"),
        (basin_entropy, (ONE, {"block": 0}), "block is 0"),
        (basin_entropy, (ONE, {"resamples": 1}), "resamples is 1"),
        (uncertainty_exponent, (ONE, {"epsilons": [1, 2, 2]}), "fewer than 3"),
        (uncertainty_exponent, (ONE, {"epsilons": [1, 2, 25]}), "not within 1 and 24"),
        (uncertainty_exponent, (ONE, {"epsilons": [1, 2, 3], "method": "boxes"}), "not within 2 and 50"),
        (uncertainty_exponent, (ONE, {"method": "balls"}), "'balls'"),
        (wada_merge_test, ([[0, 1], [-1, 0]],), r"2 labels \[0, 1\].*3 or more"),
        (wada_merge_test, (THREE, [0, 3]), "radius 0"),
        (wada_merge_test, (THREE, {"metric": "euclidean"}), "'euclidean'"),
    ],
)
def test_numbers__refuse(function, arguments, message):
    options = arguments[-1] if isinstance(arguments[-1], dict) else {}
    with pytest.raises((TypeError, ValueError), match=message):
        function(*arguments[: len(arguments) - bool(options)], **options)
