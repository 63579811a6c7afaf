"""What the page reads of a run, against the run's cube and its analyses."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from magpend_core import rates
from magpend_core.models import load_model, model_names
from pipeline.explorer import RequestError
from pipeline.explorer.data import tables
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.data.colours import NO_CODE
from pipeline.explorer.data.diagram import diagram
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.orbits import SAMPLES_PER_PERIOD, cell_of, linearise, orbit
from pipeline.explorer.data.overlays import attractors, branches, curves
from pipeline.explorer.data.planes import plane
from pipeline.explorer.data.tables import table
from pipeline.explorer.data.verticals import plain
from pipeline.explorer.data.view import describe_view
from pipeline.layout.plan import make_plan
from pipeline.layout.vocabulary import ATTRACTS, DIVERGED, PERIODIC
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive
from pipeline.specification.spec import Spec
from pipeline.store.run import RunDirectory
from pipeline.store.setup import create
from tests.pipeline.explorer.small_runs import FLOW
from tests.pipeline.factories import finished

# the same model, and the same is watched, as in tests/test_duffing_day.py: nothing more is compiled
TIGHT = "integration = { rtol = 1e-9, atol = 1e-9, n_transient = 150, n_keep = 12 }"

SWEEP = f"""
{TIGHT}
kind = "sweep"
title = "<script>alert(1)</script>"
model = "duffing"
parameters = {{ preset = "twin-well-periodic" }}
axes = {{ frequency_hz = {{ values = [0.15, 0.15915494309189535] }}, amplitude = {{ values = [0.2, 0.25, 0.3] }} }}
initial_conditions.kind = "grid"
initial_conditions.x = {{ start = -0.9375, stop = 0.9375, num = 6 }}
initial_conditions.v = {{ start = -0.5, stop = 1.0, num = 4 }}
products = {{ extremes = {{ quantities = ["energy", "v"] }} }}
"""

WALK = f"""
{TIGHT}
kind = "continuation"
model = "duffing"
parameters = {{ preset = "twin-well-periodic", frequency_hz = 0.15915494309189535 }}
axes = {{ amplitude = {{ start = 0.15, stop = 0.3, num = 4 }} }}
continuation = {{ path = "amplitude", direction = "both" }}
initial_conditions = {{ kind = "random", n = 3, seed = 2, x = [-1.0, 1.0], v = [-1.0, 1.0] }}
"""

FLOW_STARTS = f"""
{TIGHT}
initial_conditions.kind = "grid"
initial_conditions.x = {{ start = 0.6, stop = 0.9, num = 2 }}
initial_conditions.y = {{ start = 0.3, stop = 0.35, num = 2 }}
"""

SAME = 1e-6
"""Largest scaled distance between the end of an integrated period and the cube's next section: both are
integrated to 1e-9, and a period of these systems multiplies errors by some tens at most."""


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    directory = finished(tmp_path_factory.mktemp("view-sweep"), SWEEP)
    derive(directory, "basins")
    return directory


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    directory = finished(tmp_path_factory.mktemp("view-walk"), WALK)
    derive(directory, "branches", {"parameter": "amplitude"})
    return directory


@pytest.fixture(scope="module")
def flow(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("view-flow"), FLOW.partition("axes")[0] + FLOW_STARTS)


# ---- the view


@pytest.mark.slow
def test_describe_view__says_what_stands_in_a_run(sweep):
    explored = ExploredRun.open(sweep)
    found = describe_view(explored, True)
    json.dumps(found, allow_nan=False)
    cube = explored.cube()
    assert found["title"] == "<script>alert(1)</script>"
    assert found["name"] == "run"
    assert str(sweep.parent) not in json.dumps(found)
    assert found["digest"] == explored.digest
    assert (found["complete"], found["live"], found["n_keep"]) == (True, True, 12)
    assert found["cells"] == {"total": cube.status.size, "pending": 0, "failed": int((cube.status == DIVERGED).sum())}
    assert [a["name"] for a in found["axes"]] == ["frequency", "amplitude"]
    assert found["axes"][1]["values"] == cube["amplitude"].values.tolist()
    assert found["starts"] == {"dims": ["x_0", "v_0"], "count": 24}
    names = [v["name"] for v in found["verticals"]]
    assert names[:2] == list(explored.model.state_names)
    extremes = [f"{watched}.{extreme}" for watched in ("energy", "v") for extreme in ("min", "max", "mean")]
    assert names[2:] == [*(q.name for q in explored.model.quantities), *extremes]
    assert found["planes"][0] == ["x", "v"]
    assert found["has"]["attractors"]
    assert found["has"]["basins"]
    assert not found["has"]["branches"]
    assert [p["value"] is None for p in found["model"]["parameters"] if p["name"] == "amplitude"] == [True]


@pytest.mark.slow
def test_describe_view__names_commands_that_the_run_can_have(sweep, walk, made):
    # of what a run of two parameters is to be followed along, a person has to say; an atlas takes both
    assert describe_view(ExploredRun.open(sweep), False)["commands"].keys() == {"atlas"}
    assert "basins" not in describe_view(ExploredRun.open(walk), False)["commands"]  # a walk has no basins
    assert {"attractors", "basins"} <= describe_view(ExploredRun.open(made.info.directory), False)["commands"].keys()


@pytest.mark.slow
def test_describe_view__reads_what_is_computed_later(walk):
    explored = ExploredRun.open(walk)
    view = describe_view(explored, False)
    assert not view["has"]["basins"]
    assert view["axes"][0]["path"]
    assert explored.refreshed() is explored
    derive(walk, "settling")
    assert explored.refreshed() is not explored
    # whoever holds an opened run may hand it over; an explored one is taken as it is
    opened = RunDirectory.open(walk)
    assert ExploredRun.open(ExploredRun.open(opened)).digest == opened.digest
    assert ExploredRun.open(explored) is explored


def test_plain__labels_have_no_latex():
    for model in map(load_model, model_names()):
        for one in (*model.states, *model.quantities, *model.parameters):
            label = plain(one.symbol, one.name)
            assert label.strip()
            assert not set(label) & set("\\{}$^"), (model.name, label)
    assert plain(r"\dot{\theta}_1", "rate") == "θ\u0307₁"
    assert plain(r"P_\mathrm{in}", "p") == "Pᵢₙ"
    assert plain(r"\lambda", "l") == "λ"
    assert plain("", "duty_cycle") == "duty cycle"


# ---- the diagram


@pytest.mark.slow
@pytest.mark.parametrize("x", ["frequency", "amplitude"])
@pytest.mark.parametrize("y", ["v", "energy.max"])
def test_diagram__has_every_point_of_the_cube(sweep, x, y):
    """Cells are where their numbers say, and points are the cube's, whichever axis is horizontal."""
    explored = ExploredRun.open(sweep)
    cube = explored.cube().load()
    other = "amplitude" if x == "frequency" else "frequency"
    arrays, attrs = unpack_arrays(diagram(explored, x, y, {other: 1}))
    assert attrs["at"] == {other: 1}
    assert np.all(np.diff(arrays["x"]) > 0)
    assert np.all(np.diff(arrays["at"].astype(int)) >= 0)
    assert len(arrays["first"]) == len(arrays["cell"]) + 1
    status = cube["status"].values
    for k, number in enumerate(arrays["cell"]):
        index = np.unravel_index(number, status.shape)
        one = cube.isel(dict(zip(cube["status"].dims, map(int, index), strict=True)))
        assert float(one[x]) == arrays["x"][arrays["at"][k]]
        assert float(one[other]) == float(cube[other][1])
        own = arrays["y"][arrays["first"][k] : arrays["first"][k + 1]]
        kept = one["section"].sel(state=y) if y == "v" else one["extremes"].sel(quantity="energy", extreme="max")
        is_drawn = int(one["status"]) != DIVERGED
        np.testing.assert_array_equal(own, kept.values if is_drawn else [])
        assert arrays["status"][k] == int(one["status"])
    assert len(arrays["cell"]) == status.size // cube.sizes[other]


@pytest.mark.slow
def test_diagram__colours_are_those_of_the_analyses(sweep):
    explored = ExploredRun.open(sweep)
    arrays, _ = unpack_arrays(diagram(explored, "amplitude", "x", {"frequency": 0}))
    ids = derive(sweep, "attractors")["attractor_id"].transpose("frequency", "amplitude", "x_0", "v_0").values.ravel()
    expected = ids[arrays["cell"]]
    assert len(set(expected.tolist())) > 1
    np.testing.assert_array_equal(arrays["colour_attractor"], np.where(expected < 0, NO_CODE, expected))
    named = {c["id"] for c in describe_view(explored, False)["colours"][0]["categories"]}
    assert set(expected.tolist()) - {-1} <= named


@pytest.mark.slow
def test_diagram__tells_directions_and_seeds(walk):
    explored = ExploredRun.open(walk)
    arrays, _ = unpack_arrays(diagram(explored, "amplitude", "x", {}))
    cube = explored.cube()
    branch = arrays["cell"] % cube.sizes["branch"]
    np.testing.assert_array_equal(arrays["colour_direction"], cube["direction"].values[branch] == "down")
    np.testing.assert_array_equal(arrays["colour_seed"], cube["seed"].values[branch])


@pytest.mark.slow
def test_diagram__shows_the_last_sections_where_there_are_too_many(sweep):
    explored = ExploredRun.open(sweep)
    whole, _ = unpack_arrays(diagram(explored, "amplitude", "x", {"frequency": 0}))
    part, attrs = unpack_arrays(diagram(explored, "amplitude", "x", {"frequency": 0}, 72 * 5))
    assert (attrs["kept"], attrs["n_keep"]) == (5, 12)
    k = int(np.flatnonzero(np.diff(whole["first"]) == 12)[0])
    own = whole["y"][whole["first"][k] : whole["first"][k + 1]]
    np.testing.assert_array_equal(part["y"][part["first"][k] : part["first"][k + 1]], own[-5:])
    with pytest.raises(RequestError, match="71 cells at most"):
        diagram(explored, "amplitude", "x", {"frequency": 0}, 71)


@pytest.mark.slow
def test_diagram__of_a_run_in_progress_has_what_is_committed(made):
    """Pending cells are there without points; after a commit and a fresh look they have them."""
    explored = ExploredRun.open(made.info.directory)
    assert describe_view(explored, False)["cells"]["pending"] == made.plan.n_cells
    made.commit(0)
    assert explored.refreshed() is not explored
    explored = explored.refreshed()
    view = describe_view(explored, False)
    committed = made.plan.cells_in(0)
    assert not view["complete"]
    assert view["cells"]["pending"] == made.plan.n_cells - committed
    cube = explored.cube().load()
    total = 0
    for q in range(2):
        arrays, _ = unpack_arrays(diagram(explored, "frequency", "psi1", {"q": q}))
        counts = np.diff(arrays["first"].astype(int))
        np.testing.assert_array_equal(counts > 0, arrays["status"] != 0)
        total += int((counts > 0).sum())
    assert total == committed == int((cube.status != 0).sum())


# ---- orbits


def some_cells(explored, n=4):
    status = explored.cube()["status"].values.ravel()
    found = np.flatnonzero(status == PERIODIC)
    return found[:: max(1, len(found) // n)][:n].tolist()


@pytest.mark.slow
@pytest.mark.parametrize("which", ["sweep", "walk", "flow"])
def test_orbit__ends_where_the_cube_goes_on(which, request):
    """The first point is the section asked for, and each period ends at the cube's next one."""
    explored = ExploredRun.open(request.getfixturevalue(which))
    cells = some_cells(explored)
    assert cells
    for number in cells:
        cell = cell_of(explored, number)
        for point in (0, 5):
            arrays, attrs = unpack_arrays(orbit(explored, number, point))
            ends = arrays["states"][::SAMPLES_PER_PERIOD]
            assert len(ends) == attrs["n_periods"] + 1
            np.testing.assert_array_equal(ends[0], cell.section[point])
            n = min(len(ends), len(cell.section) - point)
            assert n >= 2
            if which == "flow":  # returns need not take equally long
                ends = ends[[0, -1]]
                compared = cell.section[[point, point + attrs["n_periods"]]]
            else:
                ends, compared = ends[:n], cell.section[point : point + n]
            assert np.abs(ends - compared).max() < SAME
            assert attrs["period"] == cell.period
            np.testing.assert_allclose(arrays["section_times"][-1], arrays["time"][-1], rtol=1e-12)


@pytest.mark.slow
def test_orbit__agrees_with_scipy(sweep):
    """The whole path of one period is that of DOP853 on the model's own rates."""
    explored = ExploredRun.open(sweep)
    number = some_cells(explored)[0]
    cell = cell_of(explored, number)
    arrays, attrs = unpack_arrays(orbit(explored, number, 3))
    assert attrs["frequency"] == cell.clock_hz

    def slope(t, y):
        return rates(t, y, cell.parameters, cell.clock_hz)

    times = arrays["time"]
    exact = solve_ivp(slope, (0.0, times[-1]), cell.section[3], "DOP853", times, rtol=1e-11, atol=1e-12)
    # the continuous extension between steps of 1e-9 is of order 4
    assert np.abs(exact.y.T - arrays["states"]).max() < 1e-6


@pytest.mark.slow
def test_orbit__says_what_the_cube_and_the_analysis_say(sweep):
    explored = ExploredRun.open(sweep)
    found = dense(derive(sweep, "attractors"), points=True)
    for number in some_cells(explored, 6):
        _, attrs = unpack_arrays(orbit(explored, number, 0))
        index = explored.cell(number)
        one = int(found["attractor_id"].isel(index))
        assert attrs["attractor"] == one
        assert attrs["at"] == {d: index[d] for d in ("frequency", "amplitude")}
        here = found.isel({d: index[d] for d in ("frequency", "amplitude")})
        assert attrs["share"] == float(here["share"][one])
        assert attrs["low"] <= attrs["share"] <= attrs["high"]
        assert len(attrs["seeds"]) == int(here["n_cells"][one])
        start = {name: float(explored.cube()[f"{name}_0"][index[f"{name}_0"]]) for name in ("x", "v")}
        assert attrs["start"] == start
        assert {k: attrs["seeds"][0][k] for k in start} == start
        assert attrs["parameters"]["amplitude"] == float(explored.cube()["amplitude"][index["amplitude"]])
        if int(here["orbit_period"][one]) == attrs["period"]:
            real = here["multiplier_real"][one].values
            np.testing.assert_allclose([m[0] for m in attrs["multipliers"]], real)
            assert attrs["stable"]
            assert (attrs["kind"], attrs["stability"]) == ("periodic orbit", "attracts")
            assert attrs["evidence"] == "multipliers"


@pytest.mark.slow
def test_orbit__has_multipliers_without_an_analysis(sweep, walk):
    """Polishing the cell's own section gives those that the analysis of attractors gives; first it says they come."""
    explored = ExploredRun.open(sweep)
    found = dense(derive(sweep, "attractors"), points=True)
    compared = 0
    for number in some_cells(explored, 6):
        cell, index = cell_of(explored, number), explored.cell(number)
        multipliers, seconds = linearise(cell)
        one = int(found["attractor_id"].isel(index))
        here = found.isel(frequency=index["frequency"], amplitude=index["amplitude"], attractor=one)
        if int(here["orbit_period"]) == cell.period:
            expected = here["multiplier_real"].values + 1j * here["multiplier_imag"].values
            np.testing.assert_allclose(np.sort_complex(multipliers), np.sort_complex(expected), atol=1e-6)
            assert seconds == pytest.approx(cell.period / cell.clock_hz)
            compared += 1
    assert compared
    explored = ExploredRun.open(walk)
    assert explored.kept("attractors") is not None  # what branches rest on
    number = some_cells(explored)[0]
    object.__setattr__(explored, "_opened", {**explored._opened, "derived attractors": None})
    _, attrs = unpack_arrays(orbit(explored, number, 0, linearised=False))
    assert attrs["multipliers"] is attrs["stable"] is attrs["exponents"] is None
    assert "in a moment" in attrs["note"]
    _, attrs = unpack_arrays(orbit(explored, number, 0))
    assert attrs["multipliers"]
    assert attrs["note"] is None


def test_orbit__exponents_of_a_flow_have_the_one_along_it(flow):
    explored = ExploredRun.open(flow)
    _, attrs = unpack_arrays(orbit(explored, some_cells(explored)[0], 0))
    assert attrs["frequency"] is None
    assert attrs["exponents"][0] == pytest.approx(0.0, abs=1e-9)
    assert attrs["exponents"][1] < 0.0


def test_orbit__of_a_pending_cell_is_refused(made):
    with pytest.raises(RequestError, match="not computed yet"):
        orbit(ExploredRun.open(made.info.directory), 0, 0)


def test_recorded__is_looked_at_and_not_followed_on(tmp_path):
    """Under a recorded drive there are diagrams, and no orbits, quantities or analyses."""
    rows = [f"{0.45 * k},{0.45 * k + 0.2}" for k in range(12)]
    (tmp_path / "drive.csv").write_text("\n".join(["rising_s,falling_s", *rows, "5.4,"]), "utf-8")
    text = (
        'kind = "sweep"\n[drive]\nfile = "drive.csv"\n[axes]\nq = { values = [0.6, 1.6] }\n'
        '[initial_conditions]\nkind = "list"\npoints = [[0.1, 0.0, 0.0, 0.0]]\n'
        "[integration]\nn_transient = 5\nn_keep = 3\n"
    )
    (tmp_path / "spec.toml").write_text(text, "utf-8")
    spec = Spec.read(tmp_path / "spec.toml")
    plan = make_plan(spec, text)
    create(tmp_path / "run", plan)
    explored = ExploredRun.open(tmp_path / "run")
    view = describe_view(explored, False)
    assert view["commands"] == {}
    assert [v["name"] for v in view["verticals"]] == list(explored.model.state_names)
    arrays, _ = unpack_arrays(diagram(explored, "q", view["verticals"][0]["name"], {}))
    assert len(arrays["cell"]) == 2
    with pytest.raises(RequestError, match="recording"):
        orbit(explored, 0, 0)


# ---- what lies over and beside


@pytest.mark.slow
def test_curves__are_shares_and_exponents_of_the_analysis(sweep):
    explored = ExploredRun.open(sweep)
    found = dense(derive(sweep, "attractors"), points=True).isel(frequency=1)
    listed = curves(explored, "amplitude", {"frequency": 1})["curves"]
    json.dumps(listed, allow_nan=False)
    shares = {c["attractor"]: c for c in listed if c["group"] == "fractions"}
    assert shares
    for number, one in shares.items():
        # where it is absent there is a gap, not a share of 0
        there = (found["stability"].isel(attractor=number) == ATTRACTS).values
        share = found["share"].isel(attractor=number).values
        assert [y is not None for y in one["y"]] == there.tolist()
        np.testing.assert_array_equal(np.array(one["y"], float)[there], share[there])
        for low, y, high in zip(one["low"], one["y"], one["high"], strict=True):
            assert low <= y <= high if y else low is high is None
        assert one["x"] == found["amplitude"].values.tolist()


@pytest.mark.slow
def test_branches__lie_on_the_diagram(walk):
    """Where a branch is stable, points of the cube lie on it; every located point has its branch."""
    explored = ExploredRun.open(walk)
    found = branches(explored, "amplitude", "x", {})
    json.dumps(found, allow_nan=False)
    assert found["note"] is None
    stable = [s for b in found["branches"] for s in b["segments"] if s["stable"]]
    cube = explored.cube().load()
    tried = 0
    for i in range(cube.sizes["amplitude"]):
        for j in np.flatnonzero(cube["status"].values[i] == PERIODIC):
            value = float(cube["section"].sel(state="x").values[i, j, -1])
            heights = [
                np.interp(float(cube["amplitude"][i]), *(np.array(s[k])[np.argsort(s["x"])] for k in ("x", "y")))
                for s in stable
                if min(s["x"]) <= float(cube["amplitude"][i]) <= max(s["x"])
            ]
            if heights:
                tried += 1
                # branches are joined by straight lines between steps
                assert np.abs(np.array(heights) - value).min() < 5e-3
    assert tried
    assert {p["branch"] for p in found["points"]} <= {b["id"] for b in found["branches"]}


@pytest.mark.slow
def test_attractors__are_those_of_the_point(sweep):
    explored = ExploredRun.open(sweep)
    here = dense(derive(sweep, "attractors"), points=True).isel(frequency=0, amplitude=2)
    found = attractors(explored, {"frequency": 0, "amplitude": 2})["attractors"]
    json.dumps(found, allow_nan=False)
    assert {a["id"] for a in found} == set(np.flatnonzero(here["kind"].values > 0).tolist())
    assert [a["share"] for a in found] == sorted((a["share"] for a in found), reverse=True)
    told = {(a["kind"], a["stability"], a["evidence"]) for a in found}
    assert told == {("periodic orbit", "attracts", "multipliers")}
    for one in found:
        points = here["attractor_points"].isel(attractor=one["id"]).transpose("point", "state").values
        np.testing.assert_array_equal(one["section"], points[np.isfinite(points).all(axis=1)])


@pytest.mark.slow
def test_plane__has_the_label_of_every_start(sweep):
    explored = ExploredRun.open(sweep)
    arrays, attrs = unpack_arrays(plane(explored, {"frequency": 1, "amplitude": 0}))
    assert (attrs["states"], attrs["source"]) == (["x", "v"], "basins")
    found = derive(sweep, "basins").isel(frequency=1, amplitude=0)
    expected = found["attractor_id"].transpose("v_0", "x_0")
    np.testing.assert_array_equal(arrays["u"], expected["x_0"].values)
    np.testing.assert_array_equal(arrays["v"], expected["v_0"].values)
    diverged = found["status"].transpose("v_0", "x_0").values == DIVERGED
    np.testing.assert_array_equal(arrays["label"], np.where(diverged, -2, expected.values))
    assert set(np.unique(arrays["label"])) - {-1} <= {c["id"] for c in attrs["labels"]}


@pytest.mark.slow
def test_plane__of_scattered_starts_lists_them(walk):
    explored = ExploredRun.open(walk)
    arrays, attrs = unpack_arrays(plane(explored, {"amplitude": 1}))
    assert attrs["source"] is None
    assert arrays["label"].size == 0
    cube = explored.cube()
    expected = np.stack([cube[f"{name}_0"].values for name in attrs["states"]], axis=1)
    np.testing.assert_array_equal(arrays["starts"], expected)
    assert len(arrays["start_label"]) == cube.sizes["branch"]


# ---- tables


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["diagram", "curves", "orbit", "plane", "attractors"])
def test_table__has_the_same_rows_in_both_formats(sweep, kind, tmp_path):
    explored = ExploredRun.open(sweep)
    at = {"frequency": 0} if kind in ("diagram", "curves") else {"frequency": 0, "amplitude": 1}
    asked = {"x": "amplitude", "y": "x", "at": at, "cell": some_cells(explored)[0], "point": 0}
    text = table(explored, kind, asked).decode()
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(io.StringIO("\n".join(lines))))
    path = tmp_path / "table.nc"
    path.write_bytes(table(explored, kind, asked, "nc"))
    with xr.open_dataset(path, engine="scipy") as ds:
        assert ds.sizes["row"] == len(rows) > 0
        assert ds.attrs["cube_digest"] == explored.digest
        numbers = [n for n in ds.data_vars if ds[n].dtype.kind == "f"]
        for name in numbers:
            heading = next(h for h in rows[0] if h == name or h.startswith(f"{name} ["))
            read = [float(row[heading] or "nan") for row in rows]
            np.testing.assert_array_equal(read, ds[name].values)


def test_table__a_word_is_no_formula(monkeypatch):
    """Names come from models and titles; a spreadsheet would run one that begins like a formula."""
    monkeypatch.setattr(tables, "_ROWS_AT_ONCE", 2)
    names, values = ["=1+1", "+x", "@y", "B: left", ""], [-1.0, np.nan, 0.1, 2.0, 1e-300]
    ds = xr.Dataset({"name": ("row", np.array(names)), "value": ("row", np.array(values))})
    written = ["name,value", "'=1+1,-1.0", "'+x,", "'@y,0.1", "B: left,2.0", ",1e-300"]
    assert tables._csv(ds).decode().splitlines() == written
