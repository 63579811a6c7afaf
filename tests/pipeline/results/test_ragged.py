"""Rows of sets: what is selected, stored and shown of a result made by hand."""

import numpy as np
import pytest
import xarray as xr

import magpend  # noqa: F401 - registers the accessor
from pipeline.results.ragged import dense, isel, sets, take
from pipeline.results.selection import choose, select_points

SETS = {0.1: [0], 0.2: [], 0.3: [0, 2], 0.4: [1]}
"""Ids at each frequency."""


@pytest.fixture
def found():
    """Two cells at each frequency; row r has the share r / 10 and r + 1 section points (r, k)."""
    n = [len(ids) for ids in SETS.values()]
    numbers = np.array([i for ids in SETS.values() for i in ids], np.int32)
    points = np.concatenate([[[r, k] for k in range(r + 1)] for r in range(len(numbers))]).astype(float)
    cells = np.array([[ids[0], ids[-1]] if ids else [-1, -1] for ids in SETS.values()], np.int32)
    return xr.Dataset(
        {
            "attractor_id": (("frequency", "initial_condition"), cells),
            "status": (("frequency", "initial_condition"), np.ones((4, 2), np.int8)),
            "n_sets": ("frequency", np.array(n, np.int32)),
            "kind": ("set", np.full(4, 2, np.int8)),
            "share": ("set", np.arange(4) / 10.0),
            "n_points": ("set", np.arange(1, 5, dtype=np.int32)),
            "attractor_points": (("sample", "state"), points),
            "from_set": ("transition", [1, 2]),
            "to": ("transition", [2, 0]),
            "n_to": ("transition", [5, 7]),
        },
        {"frequency": list(SETS), "attractor": ("set", numbers), "state": ["x", "v"]},
        {"n_ids": 3, "model": "duffing"},
    )


def test_rows__come_along_with_what_is_selected(found):
    part = isel(found, {"frequency": slice(1, 3)})
    assert part["n_sets"].values.tolist() == [0, 2]
    assert part["attractor"].values.tolist() == [0, 2]
    assert part["attractor_points"].values.tolist() == [[1, 0], [1, 1], [2, 0], [2, 1], [2, 2]]
    # cells that left count with the row that they left, wherever they ended
    assert [part[name].values.tolist() for name in ("from_set", "to", "n_to")] == [[0, 1], [2, 0], [5, 7]]
    assert isel(found, {"frequency": 1}).sizes["set"] == 0
    assert isel(found, {"initial_condition": 0}).sizes["set"] == 4
    for part in (
        choose(found, {"frequency": 0.4}, ("initial_condition",), ""),
        select_points(found, {"frequency": 0.4}),
    ):
        assert part["attractor"].values.tolist() == [1]
        assert part["attractor_points"].values[:, 0].tolist() == [3.0] * 4
    part = take(found, np.array([2, 1]))
    assert part["share"].values.tolist() == [0.2, 0.1]
    assert part["attractor_points"].values[:, 0].tolist() == [2, 2, 2, 1, 1]
    assert sorted(zip(part["from_set"].values.tolist(), part["n_to"].values.tolist(), strict=True)) == [(0, 7), (1, 5)]


def test_dense__every_id_has_its_place(found):
    table = dense(found, points=True)
    assert table.sizes["attractor"] == 3
    assert table["share"].transpose("frequency", "attractor").values.tolist() == [
        [0, 0, 0],
        [0] * 3,
        [0.1, 0, 0.2],
        [0, 0.3, 0],
    ]
    assert (table["kind"] > 0).sum() == 4
    points = table["attractor_points"].transpose("frequency", "attractor", "point", "state").values
    assert points[2, 2][:, 1].tolist()[:3] == [0, 1, 2]
    assert np.isnan(points[2, 2][3]).all()
    assert np.isnan(points[1]).all()
    # of a part the ids are those of the whole
    assert dense(isel(found, {"frequency": 3}))["share"].values.tolist() == [0.0, 0.3, 0.0]
    assert dense(table) is table
    # The analysis of what settles keeps some variables only
    assert "attractor_points" not in dense(found.drop_vars(["attractor_points", "n_points"]), points=True)


def test_sets__are_rows_for_xarray_and_pandas(found):
    rows = sets(found)
    assert rows["share"].groupby("attractor_id").max().to_dict()["data"] == pytest.approx([0.1, 0.3, 0.2])
    frame = rows["share"].to_dataframe()
    assert frame["frequency"].tolist() == [0.1, 0.3, 0.3, 0.4]
    assert frame["attractor_id"].tolist() == [0, 0, 2, 1]
    assert "status" not in rows
    assert found.magpend.sets().identical(rows)
    with pytest.raises(ValueError, match="needs a result with rows of sets"):
        dense(found).magpend.sets()
