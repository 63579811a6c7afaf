"""Basins of a cube: numbers known on paper, and what is said of cells without an outcome."""

import numpy as np
import pytest
import xarray as xr
from scipy.stats import binomtest

import magpend
from magpend_core.status import Status
from pipeline.analysis.basins.analysis import basins_of, basins_table
from pipeline.analysis.basins.boundaries import basin_entropy, scattered_entropy
from pipeline.analysis.basins.numbers import basin_rows
from pipeline.layout.vocabulary import ATTRACTS, PERIODIC_ORBIT
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive
from pipeline.specification.problems import SpecError

LN_2 = np.log(2.0)
DIMS = ("frequency", "psi1_0", "psi2_0")


def labelled(grids, status=None, spacing=0.1):
    """Cube and ids of cells whose attractors are given, a grid per frequency."""
    grids = np.array(grids, np.int32)
    status = np.where(grids >= 0, Status.PERIODIC, Status.BOUNDED) if status is None else np.array(status)
    coords = {
        "frequency": ("frequency", 2.0 + 0.1 * np.arange(len(grids)), {"units": "Hz"}),
        "psi1_0": spacing * np.arange(grids.shape[1]),
        "psi2_0": spacing * np.arange(grids.shape[2]),
    }
    own = [np.unique(grid[grid >= 0]) for grid in grids]
    rows = np.concatenate(own)
    ids = xr.Dataset(
        {
            "attractor_id": (DIMS, grids),
            "decision": (DIMS, (grids >= 0).astype(np.int8)),
            "status": (DIMS, status.astype(np.int8)),
            "n_sets": ("frequency", np.array([len(one) for one in own])),
            "kind": ("set", np.full(rows.size, PERIODIC_ORBIT, np.int8)),
            "stability": ("set", np.full(rows.size, ATTRACTS, np.int8)),
            "ran_out": ("frequency", np.zeros(len(grids), np.int8)),
        },
        coords={**coords, "attractor": ("set", rows)},
        attrs={"n_ids": int(grids.max()) + 1},
    )
    cube = ids[["status"]].assign(n_periods=(DIMS, 7 * np.ones(grids.shape, np.int32)))
    return cube, ids


def halves(n=60, at=33):
    """Two basins with a straight boundary."""
    return np.broadcast_to(np.arange(n) >= at, (n, n)).astype(np.int32)


def thirds(n=60):
    return np.broadcast_to(np.arange(n) * 3 // n, (n, n)).astype(np.int32)


def test_basins__a_straight_boundary():
    found = basins_of(*labelled([halves()]), box=6).isel(frequency=0)
    # a box has 55 places across the boundary, which divides it at five of them
    parts = np.arange(1, 6) / 6
    mixed = -parts * np.log(parts) - (1 - parts) * np.log(1 - parts)
    np.testing.assert_allclose(found["basin_entropy"], mixed.sum() / 55)
    # side by side from the first cell on, the boundary halves one column of boxes
    np.testing.assert_allclose(found["boundary_basin_entropy"], LN_2)
    np.testing.assert_allclose(found["uncertainty_exponent"], 1.0, atol=1e-12)
    np.testing.assert_allclose(found["boundary_dimension"], 1.0, atol=1e-12)
    assert found["above_ln2_surely"] == 0
    assert found["wada"] == -1
    assert found["fraction"].values.tolist() == [33 / 60, 27 / 60]
    assert found["count"].values.tolist() == [33 * 60, 27 * 60]
    assert found["low"][0] < 33 / 60 < found["high"][0]
    assert (found["n_periods"] == 7).all()
    assert found["uncertain"].dims == ("epsilon",)
    assert found.attrs["not_computed"] == ""
    found = basins_of(*labelled([thirds(), halves()]), radius=20)
    # the boundary of the first strip is 20 cells from that of the last
    assert found["wada_distance"].values[0] == 20
    assert found["wada"].values.tolist() == [1, -1]
    assert basins_of(*labelled([thirds()]), radius=19)["wada"].values.tolist() == [0]


def test_basins__cells_without_an_outcome():
    grid, status = halves(20, 10), np.full((20, 20), Status.PERIODIC)
    for row, code in enumerate((Status.PENDING, Status.BOUNDED, Status.STEP_LIMIT, Status.DIVERGED)):
        grid[row, :5], status[row, :5] = -1, code
    found = basins_of(*labelled([grid], [status]), interval="clopper-pearson").isel(frequency=0)
    counts = [int(found[name]) for name in ("n_pending", "n_not_settled", "n_step_limit", "n_unfinished")]
    assert counts == [5, 5, 5, 15]
    assert found["attractor"].values.tolist() == [-2, 0, 1]
    assert found["count"].values.tolist() == [5, 180, 200]
    np.testing.assert_allclose(found["fraction"], np.array([5, 180, 200]) / 400)
    np.testing.assert_allclose(found["fraction_if_all"], np.array([20, 195, 215]) / 400)
    assert (found["attractor_id"].values[:4, :5] == -1).all()
    # at most 3/N
    np.testing.assert_allclose(found["unseen_high"], 3 / 385, rtol=0.01)
    assert basins_table(found).lines[-1] == (
        "380 of 400 cells end on attractors; 5 diverged, 5 pending, 5 not settled, 5 step limit "
        "(see docs/troubleshooting.md#no-attractor)"
    )
    # every start is in one row, and the shares of all rows make 1
    rows = basins_table(found).rows
    assert [row["outcome"] for row in rows] == [
        "diverged",
        "attractor",
        "attractor",
        "pending",
        "not settled",
        "step limit",
    ]
    assert sum(row["fraction"] for row in rows) == pytest.approx(1.0)
    interval = binomtest(5, 400).proportion_ci(0.95, "exact")
    assert [rows[-1]["low"], rows[-1]["high"]] == pytest.approx([*interval])
    empty = np.full((20, 20), -1)
    status = np.stack([np.full((20, 20), Status.PERIODIC), np.full((20, 20), Status.PENDING)])
    found = basins_of(*labelled([halves(20, 8), empty], status))
    assert np.isfinite(found["basin_entropy"].values).tolist() == [True, False]
    assert found["n_sets"].values.tolist() == [2, 0]
    assert np.isnan(dense(found)["low"].values[1]).all()
    assert found["n_pending"].values.tolist() == [0, 400]


def test_basin_rows__agree_with_counts_of_each_point():
    rng = np.random.default_rng(3)
    labels = xr.DataArray(rng.integers(-2, 4, (5, 6, 40)), dims=("f", "a", "start"))
    inferred = xr.DataArray(rng.random(labels.shape) < 0.3, dims=labels.dims)
    rows = basin_rows(labels, ("f", "a"), inferred, 0.95, "clopper-pearson").assign_attrs(n_ids=4)
    filled = dense(rows)
    known = (labels != -1).sum("start")
    np.testing.assert_array_equal(filled["n_unfinished"], 40 - known)
    for outcome in filled["attractor"].values:
        own, count = filled.sel(attractor=outcome), (labels == outcome).sum("start")
        seen = count > 0
        np.testing.assert_array_equal(own["count"].where(seen, 0), count)
        np.testing.assert_array_equal(own["n_inferred"].where(seen, 0), ((labels == outcome) & inferred).sum("start"))
        np.testing.assert_array_equal(own["fraction"].where(seen), (count / 40).where(seen))
        for f, a in np.argwhere(seen.values):
            reference = binomtest(int(count[f, a]), 40).proportion_ci(0.95, method="exact")
            assert [own[end].values[f, a] for end in ("low", "high")] == pytest.approx([*reference], abs=1e-12)


def test_basins__starts_that_are_no_regular_grid():
    cube, ids = labelled([halves(20)])
    uneven = np.arange(20.0) ** 2
    found = basins_of(cube.assign_coords(psi1_0=uneven), ids.assign_coords(psi1_0=uneven))
    assert found.attrs["not_computed"] == "boundaries: psi1_0 is not evenly spaced"
    assert "basin_entropy" not in found
    starts = {"psi1_0": ("initial_condition", np.arange(20.0)), "state": ["psi1"]}
    sample = [x.isel(psi2_0=0).rename(psi1_0="initial_condition").assign_coords(starts) for x in (cube, ids)]
    found = basins_of(*sample)
    assert found.attrs["not_computed"] == "uncertainty exponent and Wada test: the starts are no grid"
    # four boxes of five cells, all of one basin
    assert found["basin_entropy"].values.tolist() == [0.0]
    assert "do not fill two boxes of 11" in basins_of(*sample, box=11).attrs["not_computed"]
    assert found["fraction"].dims == ("set",)
    found = basins_of(*labelled([halves(20, 8)]), box=21)
    assert "box (21, 21) is larger than the grid (20, 20)" in found.attrs["not_computed"]
    assert np.isnan(found["basin_entropy"]).all()
    assert np.isfinite(found["uncertainty_exponent"]).all()


def test_basin_rows__weights_are_those_of_a_density():
    """Basins [0, 1/2) and [1/2, 1] of starts with the density 2 x have the fractions 1/4 and 3/4."""
    x = (np.arange(4000) + 0.5) / 4000
    labels = xr.DataArray((x > 0.5).astype(int)[None], dims=("f", "start"))
    labels[0, :100] = -1  # unfinished: a share of 1/1600
    plain = basin_rows(labels, ("f",), xr.zeros_like(labels, bool), 0.95, "wilson")
    rows = basin_rows(labels, ("f",), xr.zeros_like(labels, bool), 0.95, "wilson", (2.0 * x)[None])
    np.testing.assert_allclose(rows["fraction"], [0.25 - 1 / 1600, 0.75], atol=1e-9)
    np.testing.assert_allclose(rows["fraction_if_all"], [0.25, 0.75 + 1 / 1600], atol=1e-9)
    np.testing.assert_allclose(rows["fraction_unfinished"], 1 / 1600, atol=1e-9)
    # (int 2x)^2 / int 4x^2 = 3/4 of the cells count
    np.testing.assert_allclose(rows["n_effective"], 3000.0, rtol=1e-6)
    assert plain["n_effective"].values.tolist() == [4000.0]
    assert rows["count"].values.tolist() == plain["count"].values.tolist() == [1900, 2000]
    interval = binomtest(2250, 3000).proportion_ci(0.95, "wilson")
    np.testing.assert_allclose([rows["low"][1], rows["high"][1]], [*interval], atol=1e-6)


def test_scattered_entropy__of_a_straight_boundary():
    """Of m boxes per side 1/m are crossed, at a place that is even in the box: their mean entropy is 1/2.

    The integral of -u ln u - (1 - u) ln(1 - u) from 0 to 1.
    """
    rng = np.random.default_rng(5)
    states = np.column_stack([rng.random((40_000, 2)), np.ones(40_000)])
    places = np.linspace(0.3, 0.7, 17)
    several = [scattered_entropy(states, (states[:, 0] > place).astype(int), 400) for place in places]
    # the first placement has 10 columns of boxes, 15 others have 9, and the boundary crosses one column of each
    assert [int(found["n_boxes"]) for found in several] == [100] * 17
    entropy, boundary = (np.mean([float(found[name]) for found in several]) for name in ("entropy", "boundary_entropy"))
    assert entropy == pytest.approx(16 * 0.5 / (10 + 15 * 9), rel=0.05)
    assert boundary == pytest.approx(0.5, rel=0.05)
    assert all(found["entropy_low"] < found["entropy"] < found["entropy_high"] for found in several)
    # riddled basins: each box has both labels in even shares
    mixed = scattered_entropy(states, rng.integers(0, 2, 40_000), 400)
    np.testing.assert_allclose([mixed["entropy"], mixed["boundary_entropy"]], LN_2, rtol=0.01)
    assert not mixed["above_ln2_surely"]
    three = scattered_entropy(states, rng.integers(0, 3, 40_000), 400)
    assert three["above_ln2_surely"]


def test_scattered_entropy__agrees_with_that_of_a_grid():
    def inside(x, y):
        return (np.hypot(x - 0.5, y - 0.5) < 0.31).astype(int)

    states = np.random.default_rng(7).random((40_000, 2))
    cells = (np.arange(200) + 0.5) / 200
    grid, scattered = basin_entropy(inside(*np.meshgrid(cells, cells))), scattered_entropy(states, inside(*states.T))
    assert float(scattered["entropy"]) == pytest.approx(float(grid["entropy"]), rel=0.08)
    assert float(scattered["boundary_entropy"]) == pytest.approx(float(grid["boundary_entropy"]), rel=0.08)


@pytest.mark.slow
def test_basins__of_a_density_and_even_samples(tmp_path):
    """Of x -> tanh(2 x), the starts above 0 go up; the density exp(-a x) on [-1, 2] has closed integrals."""
    spec = {
        "kind": "sweep",
        "model": {"name": "tanh", "kind": "map", "states": {"x": {}}, "parameters": {"a": 1.0}},
        "axes": {"a": {"values": [0.5, 2.0]}},
        "initial_conditions": {"kind": "random", "sampling": "sobol", "n": 2048, "x": [-1.0, 2.0]},
        "integration": {"n_transient": 60, "n_keep": 4},
    }
    spec["model"]["equations"] = {"x": "tanh((2 + 0*a)*x)"}
    run = magpend.run(spec, tmp_path / "run")
    found = run.basins(density="exp(-a*x)").load()
    rows = basins_table(found).rows
    for a in (0.5, 2.0):
        exact = (1.0 - np.exp(-2.0 * a)) / (np.exp(a) - np.exp(-2.0 * a))
        own = sorted(row["fraction"] for row in rows if row["a"] == a)
        assert own == pytest.approx(sorted([exact, 1.0 - exact]), abs=2e-3)
    assert found["n_effective"].values.max() < 2048
    assert np.isfinite(found["basin_entropy"].values).all()
    figure = magpend.figure(run, "fractions", {"density": "exp(-a*x)"})
    np.testing.assert_allclose(figure.data["fraction"].sum("outcome"), 1.0)
    with pytest.raises(magpend.SpecError, match="must be 0 or greater"):
        run.basins(density="x")


@pytest.mark.parametrize(
    "options", [{"box": 1}, {"radius": 0}, {"interval": "wald"}, {"confidence": 1.0}, {"resamples": 1}]
)
def test_basins__bad_options(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        basins_of(*labelled([halves(20)]), **options)


def test_derive_basins__refuses_before_it_identifies(made):
    made.commit(0)
    said = []
    with pytest.raises(SpecError, match="box = 1"):
        derive(made.info.directory, "basins", {"box": 1}, echo=said.append)
    with pytest.raises(SpecError, match=r"box = 2\.5"):
        derive(made.info.directory, "basins", {"box": 2.5})
    with pytest.raises(SpecError, match='direction = "both"'):
        derive(made.info.directory, "hysteresis", echo=said.append)
    assert not said


@pytest.mark.slow
def test_derive_basins__of_an_incomplete_run(made):
    made.commit(0)
    derive(made.info.directory, "attractors", {"polish": False})
    found = derive(made.info.directory, "basins", {"box": 2})
    n = made.plan.cells_in(0)
    assert int((found["status"] > 0).sum()) == n
    assert int(found["n_pending"].sum()) == made.plan.n_cells - n
    reasons = [one for one in found.values() if "cells without" in one.attrs.get("long_name", "")]
    assert not (found["n_unfinished"] - sum(reasons)).any()
    again = derive(made.info.directory, "basins", {"box": 2})
    xr.testing.assert_identical(found, again)
