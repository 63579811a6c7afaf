"""Tables of results: headers without rows, and parameters that have the name of a column."""

from __future__ import annotations

import csv

import numpy as np
import pytest
import xarray as xr

from pipeline.products.product import Table
from pipeline.results.tabular import Row, header_of, plain_table, points_of, shown
from pipeline.runs.derive import derive, shown_table
from pipeline.runs.run import run

NAMES = ("delta", "rate", "label", "period", "plain")


def table(ds: xr.Dataset) -> Table:
    """A row for each point, with a column ``period`` and a line that names the parameter of the result."""
    rows: list[Row] = [
        {**where, "period": 3, "label": f"at {ds.attrs['parameter']}"}
        for _, where in points_of(ds, [str(d) for d in ds["n"].dims])
    ]
    lines = [f"along {ds.attrs['parameter']}", *(f"{name} = {value}" for row in rows for name, value in row.items())]
    return Table(rows, lines, graph={"nodes": [{"sentence": lines[0]}]})


def result(name: str) -> xr.Dataset:
    return xr.Dataset({"n": (name, [1, 2])}, {name: [0.5, 1.5]}, {"parameter": name})


@pytest.mark.parametrize("name", NAMES)
def test_shown__a_parameter_with_the_name_of_a_column_has_its_own(name) -> None:
    column = f"parameter_{name}" if name in ("label", "period") else name
    found = shown(result(name), table)
    assert [row[column] for row in found.rows] == [0.5, 1.5]
    assert [row["period"] for row in found.rows] == [3, 3]
    assert found.lines[:2] == [f"along {name}", f"{name} = 0.5"]
    assert found.rows[0]["label"] == f"at {name}"
    assert found.graph == {"nodes": [{"sentence": f"along {name}"}]}
    assert list(found.rows[0]) == [column, "period", "label"]


def test_shown__the_drives_rate_keeps_its_column() -> None:
    ds = result("omega")
    assert list(shown(ds, table).rows[0]) == ["omega", "period", "label"]


def test_header_of__names_the_columns_of_a_result_without_rows() -> None:
    ds = xr.Dataset(
        {"kind": ("jump", np.zeros(0, np.int8), {"flag_meanings": "a b"}), "x": (("jump", "k"), np.zeros((0, 2)))}
    )
    assert header_of(ds, "jump", lambda one: {"kind": int(one["kind"]), "x1": float(one["x"][1])}) == ("kind", "x1")
    text = Table([], [], header=("kind", "x1")).csv()
    assert text == "kind,x1\n"


@pytest.mark.slow
@pytest.mark.parametrize("first", NAMES)
def test_tables__of_a_map_whose_parameters_have_the_names_of_columns(first, tmp_path) -> None:
    """Henon's map with b = 0.3: its fold lies at -(1 - b)^2/4, and period 2 is born at 3 (1 - b)^2/4."""
    second = next(name for name in NAMES if name != first)
    data = {
        "kind": "sweep",
        "model": {
            "name": "henon",
            "kind": "map",
            "states": {"x": {}, "y": {}},
            "parameters": {first: 1.0, second: 0.3},
            "equations": {"x": f"1 - {first}*x**2 + y", "y": f"{second}*x"},
        },
        "axes": {first: {"values": [0.1, 0.2, 0.3]}},
        "initial_conditions": {"kind": "list", "points": [[0.1, 0.1], [0.3, 0.0]]},
        "integration": {"n_transient": 200, "n_keep": 16},
    }
    run(data, tmp_path / "r", workers=0, echo=lambda _: None)
    plane = {"second": second, "second_low": 0.2, "second_high": 0.4}
    for name, options in (
        ("attractors", {}),
        ("branches", {"low": -0.2, "high": 0.5}),
        ("sensitivities", {}),
        ("curves", plane),
    ):
        found = shown_table(name, derive(tmp_path / "r", name, options))
        header = next(csv.reader(found.csv().splitlines()))
        assert len(set(header)) == len(header)
        own = {f"parameter_{first}", first} & set(header)
        assert own, (name, header)
        if name == "branches":
            column = f"parameter_{first}" if first in ("label", "period") else first
            np.testing.assert_allclose(
                sorted(row[column] for row in found.rows), [-(0.7**2) / 4.0, 3.0 * 0.7**2 / 4.0], rtol=1e-7
            )
        if name == "curves":
            assert {f"parameter_{second}", second} & set(header)


def test_plain_table__has_a_row_for_each_combination_of_the_coordinates():
    flags = {"flag_values": [0, 1], "flag_meanings": "rests moves"}
    ds = xr.Dataset(
        {"low": (("F", "state"), [[1.0, 2.0], [3.0, np.nan]], {"units": "m"}), "kind": ("F", [1, 0], flags)},
        {"F": ("F", [0.5, 1.5], {"units": "N"}), "state": ["x", "v"]},
    )
    table = plain_table(ds)
    assert [list(row.values())[:2] for row in table.rows] == [[0.5, "x"], [0.5, "v"], [1.5, "x"], [1.5, "v"]]
    assert [row["low"] for row in table.rows[:3]] == [1.0, 2.0, 3.0]
    assert [row["kind"] for row in table.rows] == ["moves", "moves", "rests", "rests"]
    assert table.lines[0].split() == ["F", "[N]", "state", "low", "[m]", "kind"]
    assert table.lines[-1].split() == ["1.5", "v", "-", "rests"]
    long = plain_table(xr.Dataset({"n": ("F", np.arange(40))}, {"F": np.arange(40.0)}))
    assert (len(long.rows), long.lines[-1]) == (40, "and 10 more rows; all are in --csv and --json")
