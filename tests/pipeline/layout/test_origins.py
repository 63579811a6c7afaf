"""Starts that are counted from expressions of the parameters: what is integrated, shown, and refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import magpend
from pipeline.layout.cells import CellMap
from pipeline.layout.evaluation import check_starts
from pipeline.layout.matching import NOWHERE, Finder
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec

MODEL = {
    "name": "two-wells",
    "states": {"x": {}, "v": {}},
    "parameters": {"a": 1.0, "d": 0.3},
    "equations": {"x": "v", "v": "a*x - x**3 - d*v + 0.2*cos(2*pi*f*t)"},
}
STARTS: dict[str, dict[str, Any]] = {
    "grid": {"x": {"start": -0.1, "stop": 0.1, "num": 3}, "v": {"start": 0.0, "stop": 0.2, "num": 2}},
    "random": {"n": 6, "x": [-0.1, 0.1], "v": [0.0, 0.2]},
    "list": {"points": [[-0.1, 0.0], [0.1, 0.2], [0.3, 0.0], [0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]},
}
ORIGIN = {"x": "sqrt(a)", "v": "a*f"}


def spec_of(kind: str = "grid", origin: dict[str, str] | None = ORIGIN, **more: Any) -> Spec:
    starts = {"kind": kind, **STARTS[kind], **({"origin": origin} if origin else {})}
    tables = {
        "kind": "sweep",
        "model": MODEL,
        "parameters": {"frequency_hz": 0.2},
        "axes": {"a": {"values": [0.25, 1.0, 4.0]}, "frequency_hz": {"values": [0.2, 0.3]}},
        "initial_conditions": starts,
        "integration": {"n_transient": 20, "n_keep": 4},
    }
    tables["parameters"] = {}
    return Spec.parse({**tables, **more})


def inputs_of(spec: Spec) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    cells = CellMap(spec)
    inputs = cells.inputs(tuple(slice(0, n) for n in cells.shape))
    place = cells.names.index("a")
    return inputs.initial_states, inputs.parameters[:, 0, place], inputs.frequency_hz[:, 0]


@pytest.mark.parametrize("kind", STARTS)
def test_inputs__starts_are_counted_from_the_expressions(kind: str) -> None:
    plain, _, _ = inputs_of(spec_of(kind, None))
    states, a, f = inputs_of(spec_of(kind))
    np.testing.assert_array_equal(states[:, 0], plain[:, 0] + np.sqrt(a))
    np.testing.assert_array_equal(states[:, 1], plain[:, 1] + a * f)


def test_spec__keeps_its_origin() -> None:
    made = spec_of(origin=None).with_start_grid(origin=ORIGIN, x=(-0.1, 0.1, 3))
    assert dict(made.initial_conditions.origin or {}) == ORIGIN
    again = Spec.parse(made.as_dict())
    assert again.initial_conditions.plain()["origin"] == ORIGIN


@pytest.mark.parametrize(
    ("origin", "more", "problem"),
    [
        ({"y": "a"}, {}, "origin: unknown state 'y'"),
        ({"x": "sqrt(b)"}, {}, r"origin.x = 'sqrt\(b\)'.*'b'"),
        ({"x": "x + a"}, {}, "unknown name 'x'"),
        ({"x": "a"}, {"drift": {"d": {"from": 0.1, "to": 0.2}}}, "drop origin or"),
    ],
)
def test_spec__refuses(origin: dict[str, str], more: dict[str, Any], problem: str) -> None:
    with pytest.raises(SpecError, match=problem):
        spec_of("grid", origin, **more)


def test_check_starts__refuses_origins_without_a_value() -> None:
    with pytest.raises(SpecError, match=r"initial_conditions.origin.x = 'sqrt\(a - 1\)': is nan at a = 0.25"):
        check_starts(spec_of("grid", {"x": "sqrt(a - 1)"}))
    check_starts(spec_of("grid", {"x": "sqrt(a)"}))


def test_finder__takes_no_cells_of_a_run_with_an_origin() -> None:
    """What is counted from an expression is not found again to the last bit."""
    cells = CellMap(spec_of())
    inputs = cells.inputs(tuple(slice(0, n) for n in cells.shape))
    assert (Finder(cells).find(inputs) == NOWHERE).all()
    plain = CellMap(spec_of(origin=None))
    assert (Finder(plain).find(plain.inputs(tuple(slice(0, n) for n in plain.shape))) != NOWHERE).all()


@pytest.mark.slow
def test_run__has_the_cells_of_runs_with_these_starts(tmp_path) -> None:
    run = magpend.run(spec_of(), tmp_path / "moved")
    cube = run.cube()
    assert cube["x_0"].attrs["counted_from"] == "sqrt(a)"
    assert cube["x_0"].attrs["long_name"].endswith("counted from sqrt(a)")
    for i, a in enumerate([0.25, 1.0, 4.0]):
        points = [[x + np.sqrt(a), v + a * 0.3] for x in (-0.1, 0.0, 0.1) for v in (0.0, 0.2)]
        starts = {"kind": "list", "points": points}
        axes = {"a": {"values": [a]}, "frequency_hz": {"values": [0.3]}}
        own = spec_of("list", None, axes=axes, initial_conditions=starts)
        alone = magpend.run(own, tmp_path / f"at-{i}").cube()["section"].isel(a=0, frequency=0).values
        here = cube["section"].isel(a=i, frequency=1).values.reshape(alone.shape)
        np.testing.assert_allclose(here, alone, rtol=1e-12, atol=1e-13)
    found = run.basins().load()
    np.testing.assert_allclose(found["n_cells"], 6)
    with pytest.raises(SpecError, match="a density needs the same starts at all parameters"):
        run.basins(density="exp(-x**2)")
    with pytest.raises(SpecError, match="resilience needs the same starts"):
        run.resilience()
    with pytest.raises(SpecError, match="the overlap of basins needs the same starts"):
        run.overlaps(parameter="a", before=0.25, after=1.0, at={"frequency": 0.3})
    assert (
        "\u2212 (sqrt(a))" in magpend.figure(run, "basins", {"at": {"a": 1.0, "frequency": 0.3}}).axes[0].get_xlabel()
    )


@pytest.mark.slow
def test_explorer__shows_starts_where_they_are(tmp_path) -> None:
    from pipeline.explorer.data.explored import ExploredRun
    from pipeline.explorer.data.orbits import cell_of, seeds
    from pipeline.explorer.data.planes import plane_of
    from pipeline.store.run import RunDirectory

    magpend.run(spec_of(), tmp_path / "moved")
    explored = ExploredRun.open(RunDirectory.open(tmp_path / "moved"))
    at = {"a": 2, "frequency": 1}
    plane = plane_of(explored, at)
    np.testing.assert_allclose(plane.u, np.array([-0.1, 0.0, 0.1]) + 2.0)
    np.testing.assert_allclose(plane.v, np.array([0.0, 0.2]) + 4.0 * 0.3)
    cell = cell_of(explored, explored.plan.n_cells - 1)
    assert [seeds(explored, cell)[0][name] for name in ("x", "v")] == pytest.approx(cell.start.tolist())
    assert cell.start.tolist() == pytest.approx([2.1, 1.4])
