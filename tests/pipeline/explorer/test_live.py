"""What is computed live, against the cube and the analysis of the same run."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from magpend_core.models import load_model
from magpend_core.orbits import polish_orbits
from pipeline.analysis.attractors.destinations import destinations_at
from pipeline.analysis.attractors.finding.points import SECTION_BYTES, Dynamics, slabs
from pipeline.explorer.data.colours import rgb
from pipeline.explorer.live import slices
from pipeline.explorer.live.catalog import Entry
from pipeline.explorer.live.live import Legend, LiveRun
from pipeline.explorer.live.messages import MOST_BYTES, Region
from pipeline.explorer.live.orbit_following import _period_of_attractor
from pipeline.explorer.live.regions import zoom_toml, zoomed
from pipeline.explorer.live.settling import settle_cells
from pipeline.layout.vocabulary import (
    ABSENT,
    ATTRACTS,
    DIVERGED,
    EQUILIBRIUM,
    NEUTRAL,
    NOT_SETTLED,
    PERIODIC_ORBIT,
    UNSTABLE,
    split_dims,
)
from pipeline.plots import palette
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive
from pipeline.runs.status import state
from pipeline.specification.spec import Spec
from pipeline.store.run import RunDirectory
from tests.pipeline.explorer.small_runs import FLOW, HZ
from tests.pipeline.factories import finished

DRIVEN = """
kind = "sweep"
model = "duffing5"
axes.A = { values = [0.2, 0.25] }
parameters = { frequency_hz = 0.15915494309189535 }
initial_conditions.kind = "grid"
initial_conditions.x = { start = -0.9375, stop = 0.9375, num = 16 }
initial_conditions.v = { start = -0.5, stop = 1.0, num = 7 }
integration = { rtol = 1e-7, atol = 1e-7, n_transient = %d, n_keep = 12, stop_when_closed = %s }
"""


def test_follow__period_of_a_cell_is_that_of_its_attractor(little):
    live = LiveRun(RunDirectory.open(little))
    periods = live.cube["orbit_period"].values
    found = [_period_of_attractor(live, {"x_0": i}) for i in range(periods.size)]
    live.close()
    assert np.all((periods == 0) | (periods % np.array(found) == 0))
    assert min(found) > 0


@pytest.fixture(scope="module")
def directories(tmp_path_factory):
    """Runs of a driven system, one of which stops when closed, and of a flow at two sections, with attractors."""
    folder = tmp_path_factory.mktemp("live")
    slanted = FLOW.replace('of = "y"', 'of = "y - 0.4*x + 0.2*x*y"')
    texts = {"whole": DRIVEN % (120, "false"), "closing": DRIVEN % (200, "true"), "flow": FLOW, "slanted": slanted}

    class Made(dict):
        """Each run is made when it is asked for."""

        def __missing__(self, name):
            self[name] = finished(folder / name, texts[name])
            derive(self[name], "attractors")
            return self[name]

    return Made()


def start_of(cube, at):
    names = [n for n in ("x", "v", "y") if f"{n}_0" in cube.coords]
    one = cube.isel(at)
    return one, {name: float(one[f"{name}_0"]) for name in names}


# ---- starts --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["whole", "closing"])
def test_start__has_the_bits_and_the_attractor_of_the_cell(directories, watch, name):
    opened = RunDirectory.open(directories[name])
    cube, attractors = opened.cube(), derive(directories[name], "attractors")
    watcher, seen = watch(opened), set()
    ids = attractors["attractor_id"].transpose("A", "x_0", "v_0").values
    # cells of every attractor at each value, and of none
    cells = [(a, *i) for a in (0, 1) for k in np.unique(ids[a]) for i in np.argwhere(ids[a] == k)[:3].tolist()]
    for a, x, v in cells:
        one, start = start_of(cube, {"A": a, "x_0": x, "v_0": v})
        number = watcher.send(do="start", parameters={"A": float(one["A"])}, state=start)
        end = watcher.wait(number)
        assert end["kind"] == "done", end
        own = int(attractors["attractor_id"].isel(A=a, x_0=x, v_0=v))
        assert end["attractor"] == (own if own >= 0 else None)
        # what is kept ends where the cube's does; a start that is run on has more
        n = int(one["n_periods"])
        np.testing.assert_array_equal(watcher.sections(number)[n - 12 : n], one["section"].values)
        if one["orbit_period"] > 0:
            assert end["period"] == int(one["orbit_period"])
            assert end["status"] == "periodic"
        seen.add(own)
    assert seen == set(np.unique(ids))
    assert len(seen) >= 5


def test_start__shows_its_path_first(directories, watch):
    watcher = watch(directories["whole"])
    watcher.ask(do="start", parameters={"A": 0.2}, state={"x": 0.3})  # compiles
    number = watcher.send(do="start", parameters={"A": 0.2}, state={"x": -0.3, "v": 0.1})
    first = watcher.wait(number, "path")
    watcher.wait(number)
    paths = [a for a in watcher.of(number) if a["kind"] == "path"]
    assert watcher.of(number)[0] is first
    states = np.concatenate([p["arrays"]["states"] for p in paths])
    time_s = np.concatenate([p["arrays"]["time"] for p in paths])
    np.testing.assert_array_equal(states[0], [-0.3, 0.1])
    # it passes the sections that are told, a period apart, and goes on smoothly between its pieces
    sections = next(a for a in watcher.of(number) if a["kind"] == "sections")["arrays"]["section"]
    for k in range(5):
        i = int(np.abs(time_s - (k + 1) / HZ).argmin())
        np.testing.assert_allclose(states[i], sections[k], atol=1e-4)  # two integrators at 1e-7
    assert np.abs(np.diff(states, axis=0)).max() < 0.1


def test_start__off_the_cube_is_told_by_its_orbit(directories, watch):
    """Between the run's values, where nothing is known: equal orbits are one, different ones are not."""
    watcher = watch(directories["whole"])
    ends = [
        watcher.ask(do="start", parameters={"A": 0.21}, state=s)
        for s in ({"x": 0.9375, "v": 0.5}, {"x": 0.92, "v": 0.5}, {"x": 0.0, "v": 0.0})
    ]
    assert all(end["attractor"] is None and end["status"] == "periodic" for end in ends)
    assert ends[0]["number"] == ends[1]["number"]
    assert ends[0]["label"].startswith("not among the run's: period")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flow", "slanted"])
def test_start__ends_of_a_flow(directories, watch, name):
    """At rest or on the cycle, as the analysis says of the cell; what leaves, and what lies beside, says so."""
    cube = RunDirectory.open(directories[name]).cube()
    attractors = dense(derive(directories[name], "attractors"))
    watcher, kinds = watch(directories[name]), set()
    for mu in (0, 1):
        for at in ((1, 1), (0, 0), (2, 2), (1, 2)):
            one, start = start_of(cube, {"mu": mu, "x_0": at[0], "y_0": at[1]})
            end = watcher.ask(do="start", parameters={"mu": float(one["mu"])}, state=start)
            own = int(attractors["attractor_id"].isel(mu=mu, x_0=at[0], y_0=at[1]))
            assert end["attractor"] == own, (mu, at, end)
            kinds.add(int(attractors["kind"].isel(mu=mu, attractor=own)))
    assert kinds == {EQUILIBRIUM, PERIODIC_ORBIT}
    rest = watcher.ask(do="start", parameters={"mu": -0.15}, state={"x": 0.05, "y": 0.1})
    assert rest["label"] == "not among the run's: at rest"
    cycle = watcher.ask(do="start", parameters={"mu": -0.15}, state={"x": 0.9, "y": 0.1})
    assert (cycle["period"], cycle["attractor"]) == (1, None)
    # the quintic term drives it apart
    end = watcher.ask(do="start", parameters={"quintic": 1.0, "mu": 0.1}, state={"x": 2.0, "y": 2.0})
    assert (end["kind"], end["attractor"]) == ("done", None)
    assert end["status"] in ("diverged", "step_limit", "step_underflow")


@pytest.mark.slow
def test_start__is_superseded_and_cancelled(directories, watch):
    watcher = watch(directories["whole"])
    watcher.ask(do="start", parameters={"A": 0.2}, state={"x": 0.3})
    first = watcher.send(do="start", parameters={"A": 0.2}, state={"x": 0.3}, periods=20_000)
    second = watcher.send(do="start", parameters={"A": 0.2}, state={"x": 0.3})
    assert watcher.wait(first)["cancelled"] is True
    assert watcher.wait(second)["attractor"] is not None


def test_legend__names_end_with_what_is_known_of_the_stability():
    """What does not attract is not shown as an attractor: it says so, and is grey."""
    point = np.zeros((1, 2))
    entries = [
        Entry(0, None, PERIODIC_ORBIT, 2, 0, 0, point, stability=ATTRACTS),
        Entry(1, None, PERIODIC_ORBIT, 3, 0, 0, point, stability=UNSTABLE),
        Entry(2, None, EQUILIBRIUM, 0, 0, 0, point, stability=NEUTRAL),
        Entry(3, None, ABSENT, 0, 0, 0, point[:0], stability=NOT_SETTLED),
        Entry(4, None, ABSENT, 0, 0, DIVERGED, point[:0]),
    ]
    catalog = SimpleNamespace(model=load_model("duffing"), entries=entries)
    lines = Legend(catalog, None).lines()
    names = ["period 2", "period 3, unstable", "at rest, neutral", "not periodic, not settled", "diverged"]
    assert [line["label"] for line in lines] == names
    greys = ("on an unstable orbit or equilibrium", "on a neutral set", "not settled", "diverged")
    assert [line["colour"] for line in lines[1:]] == [rgb(palette.GREYS[name]) for name in greys]
    assert lines[0]["colour"] in palette.COLOURS


# ---- slices --------------------------------------------------------------------------------------


def slice_of(x, v, resolution, **parameters):
    """A message that asks for a slice of the plane of both states."""
    return {
        "do": "slice",
        "parameters": {"A": 0.2, **parameters},
        "plane": ["x", "v"],
        "ranges": [x, v],
        "resolution": resolution,
    }


@pytest.mark.slow
def test_slice__is_that_of_the_cube_and_computes_no_start_twice(directories, watch, monkeypatch):
    starts = []

    def counted(place, integration, catalog, states, check):
        starts.append(states)
        return settle_cells(place, integration, catalog, states, check)

    monkeypatch.setattr(slices, "settle_cells", counted)
    opened = RunDirectory.open(directories["whole"])
    attractors = dense(derive(directories["whole"], "attractors"), points=True)
    cube = opened.cube()
    watcher = watch(opened)
    # its 16 columns are the run's own: centres of cells of 0.125; four of its rows are
    number = watcher.send(**slice_of([-1.0, 1.0], [-0.515625, 0.484375], 32))
    end = watcher.wait(number)
    assert end["kind"] == "done", end
    images = [a for a in watcher.of(number) if a["kind"] == "slice"]
    whole = [a for a in images if a["share_done"] == 1.0]
    assert [a["resolution"] for a in whole] == [16, 32]
    fine, coarse = (a["arrays"]["label"] for a in reversed(whole))
    np.testing.assert_array_equal(fine[::2, ::2], coarse)
    assert sum(map(len, starts)) == 32 * 32
    assert len(np.unique(np.concatenate(starts), axis=0)) == 32 * 32
    u, v = whole[-1]["arrays"]["u"], whole[-1]["arrays"]["v"]
    known = {line["id"] for line in end["labels"] if line["attractor"] is not None}
    assert known <= set(attractors["attractor_id"].isel(A=0).values.ravel().tolist())
    assert abs(sum(end["shares"].values()) - 1.0) < 1e-12
    # a start of the plane ends where a live start, and so a cell, ends
    rng = np.random.default_rng(1)
    for row, column in rng.integers(0, 32, (8, 2)):
        one = watcher.ask(do="start", parameters={"A": 0.2}, state={"x": float(u[column]), "v": float(v[row])})
        assert one["number"] == fine[row, column]
    assert cube.sizes["x_0"] == 16


def test_slice__without_an_analysis_tells_orbits_apart(directories, watch):
    watcher = watch(directories["whole"])
    end = watcher.ask(**slice_of([-1, 1], [-0.5, 1], 16, d=0.081))
    orbits = [line for line in end["labels"] if "period" in line["label"]]
    assert len(orbits) >= 5
    assert all(line["attractor"] is None for line in end["labels"])
    assert len({line["colour"] for line in orbits}) == len(orbits)
    assert len({line["label"] for line in end["labels"]}) == len(end["labels"])


# ---- orbits that follow --------------------------------------------------------------------------


def cell_of(live, **at):
    status = live.cube["status"]
    index = [at[str(d)] for d in status.dims]
    return int(np.ravel_multi_index(index, status.shape))


def closed_cell(live):
    period = live.cube["orbit_period"].isel(A=0).transpose("x_0", "v_0").values
    x, v = np.argwhere(period == 1)[0]
    return cell_of(live, A=0, x_0=int(x), v_0=int(v))


def follow(watcher, origin, value, parameter="A"):
    """The orbit that is found from a cell or an orbit at a value."""
    orbit = watcher.ask("orbit", "error", do="follow", **{"from": origin}, parameter=parameter, value=value)
    assert orbit["kind"] == "orbit", orbit
    return orbit


def test_follow__is_the_orbit_at_the_value(directories, watch):
    live = LiveRun(RunDirectory.open(directories["whole"]))
    watcher = watch(live)
    orbit = follow(watcher, {"cell": closed_cell(live), "point": 2}, 0.23)
    assert (orbit["lost"], orbit["value"], orbit["parameters"]["A"]) == (False, 0.23, 0.23)
    place = live.place({"A": 0.23}, None)
    section = orbit["arrays"]["section"]
    start = (place.parameters.pack()[None], np.array([HZ]), section[-1:], np.array([orbit["period"]]))
    again = polish_orbits(*start, system=live.model.system)
    assert again.converged[0]
    np.testing.assert_allclose(again.section[0], section[-1], atol=1e-7)
    found = np.array([complex(*m) for m in orbit["multipliers"]])
    np.testing.assert_allclose(np.abs(found), np.abs(again.multipliers[0]), rtol=1e-5)
    # Liouville: the multipliers' product is exp(-d T)
    np.testing.assert_allclose(np.prod(found).real, np.exp(-0.08 / HZ), rtol=1e-6)
    assert orbit["stable"] == bool(np.abs(found).max() < 1.0)
    states = orbit["arrays"]["states"]
    np.testing.assert_allclose(states[0], states[-1], atol=1e-6)  # it closes


@pytest.mark.slow
def test_follow__goes_through_unstable_parts_and_says_where_it_is_lost(directories, watch):
    live = LiveRun(RunDirectory.open(directories["whole"]))
    watcher = watch(live)
    held = {"cell": closed_cell(live), "point": 0}
    stable = []
    for value in (0.22, 0.3, 0.4, 0.55, 0.7, 0.9, 1.2, 1.6, 2.0, 3.0, 5.0):
        orbit = follow(watcher, held, value)
        stable.append(orbit["stable"])
        held = {"orbit": orbit["orbit"]}
        if orbit["lost"]:
            break
    back = follow(watcher, held, 1e-6)
    lost = [a for a in (orbit, back) if a["lost"]]
    assert lost
    assert all("lost at A = " in a["sentence"] and a["value"] != a["wanted"] for a in lost)
    assert {True} <= set(stable)


@pytest.mark.slow
def test_follow__refuses_with_a_sentence(directories, watch):
    live = LiveRun(RunDirectory.open(directories["whole"]))
    watcher, cell = watch(live), closed_cell(live)
    for origin, parameter, value, word in (
        ({"cell": 10**9, "point": 0}, "A", 0.2, "the cube has"),
        ({"cell": cell, "point": 10**6}, "A", 0.2, "12 sections"),
        ({"orbit": 77}, "A", 0.2, "no orbit of this page"),
        ({"cell": cell}, "B", 0.2, "no parameter"),
        ({"cell": cell}, "d", -1.0, "d = -1"),
        ({"cell": cell}, "frequency", 1e-9, "must be from"),
    ):
        assert word in watcher.ask(do="follow", **{"from": origin}, parameter=parameter, value=value)["error"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flow", "slanted"])
def test_follow__of_a_flow(directories, watch, name):
    live = LiveRun(RunDirectory.open(directories[name]))
    watcher = watch(live)
    period = live.cube["orbit_period"].isel(mu=1).transpose("x_0", "y_0").values
    x, y = map(int, np.argwhere(period == 1)[0])
    orbit = follow(watcher, {"cell": cell_of(live, mu=1, x_0=x, y_0=y)}, -0.2, "mu")
    radius = np.hypot(*orbit["arrays"]["states"].T)
    np.testing.assert_allclose(radius**2, 0.5 * (1.0 + np.sqrt(1.0 - 0.8)), atol=1e-7)
    assert orbit["frequency"] is None
    np.testing.assert_allclose(orbit["seconds"], np.pi, rtol=1e-8)
    # at mu = -1/4 the two cycles meet
    gone = follow(watcher, {"orbit": orbit["orbit"]}, -0.3, "mu")
    assert gone["lost"]
    assert abs(gone["value"] + 0.25) < 1e-3
    assert "fold" in gone["sentence"]


# ---- regions -------------------------------------------------------------------------------------


REGION = {"x": [-0.5, 0.5], "y": [0.0, 0.5], "axes": ["x_0", "v"], "at": {"A": 1}}


def test_zoomed__is_the_region_and_reads_back(directories, tmp_path):
    opened = RunDirectory.open(directories["whole"])
    region = Region.model_validate_json(json.dumps(REGION))
    (tmp_path / "zoom.toml").write_text(zoom_toml(opened, region))
    spec = Spec.read(tmp_path / "zoom.toml")
    assert spec == zoomed(opened, region)[0]
    assert spec.values["A"] == 0.25
    assert not spec.axes
    # a diagram's height is no range of starts, and digits that no hand can mean are not kept
    one = Region.model_validate_json('{"x": [0.2012345678, 0.24], "y": [-1, 1], "axes": ["A", "x"]}')
    spec, _ = zoomed(opened, one)
    np.testing.assert_array_equal(spec.axes["A"].array(), [0.20123, 0.24])
    assert spec.initial_conditions == opened.spec.initial_conditions


@pytest.mark.slow
def test_run__a_region_beside_the_run(directories, watch, monkeypatch):
    watcher = watch(directories["whole"])
    beside = directories["whole"].parent
    before = {p.name for p in beside.iterdir()}
    first = watcher.send(do="run", **REGION)
    told = watcher.wait(first, "progress")
    watcher.send(do="cancel", job=first)
    assert watcher.wait(first)["cancelled"] is True
    watcher.session.join()
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.explorer.live.regions.MOST_OF_REGION", 50)
        assert "112 cells" in watcher.ask(do="run", **REGION)["error"]
    # what was begun is gone on with, under the same name
    second = watcher.send(do="run", **REGION)
    end = watcher.wait(second)
    assert end["kind"] == "done", end
    assert end["name"] == told["name"]
    assert {p.name for p in beside.iterdir()} == before | {end["name"]}
    assert state(beside / end["name"]).complete
    last = [a for a in watcher.of(second) if a["kind"] == "progress"][-1]
    assert last["done"] == last["total"] == end["cells"] == 112
    cube = RunDirectory.open(beside / end["name"]).cube()
    np.testing.assert_allclose(cube["x_0"].values[[0, -1]], [-0.5, 0.5])


# ---- messages ------------------------------------------------------------------------------------


HOSTILE = [
    "",
    "null",
    "[]",
    "[" * 60_000,
    "{",
    '{"id": 1}',
    '{"id": -1, "do": "start"}',
    '{"id": 1e400, "do": "cancel", "job": 1}',
    '{"id": 1, "do": "delete"}',
    '{"id": 1, "do": "start", "state": {"x": NaN}}',
    '{"id": 1, "do": "start", "state": {"x": "1"}}',
    '{"id": 1, "do": "start", "periods": 1000000000}',
    '{"id": 1, "do": "start", "frequency": -1}',
    '{"id": 1, "do": "start", "path": "/etc/passwd"}',
    '{"id": 1, "do": "slice", "plane": ["x", "v"], "ranges": [[0, 1], [0, 1]], "resolution": 513}',
    '{"id": 1, "do": "slice", "plane": ["x"], "ranges": [[0, 1], [0, 1]]}',
    '{"id": 1, "do": "follow", "from": {"cell": -1}, "parameter": "A", "value": 1}',
    '{"id": 1, "do": "follow", "from": {}, "parameter": "A", "value": 1}',
    '{"id": 1, "do": "run", "x": [0, 1], "out": "../../x"}',
    '{"id": 1, "do": "run", "x": [0]}',
    '{"id": 1, "do": "start", "state": {"' + "x" * 5000 + '": 1}}',
    '{"id": 1, "do": "start", "state": {' + ", ".join(f'"s{i}": 0' for i in range(300)) + "}}",
    " " * (MOST_BYTES + 1),
    b"\xff\xfe\x00",
    "\ud800",
]


@pytest.mark.slow
def test_receive__answers_what_is_wrong_and_goes_on(directories, watch):
    watcher = watch(directories["whole"])
    for text in HOSTILE:
        n = len(watcher.answers)
        watcher.session.receive(text)
        (said,) = (a["error"] for a in watcher.answers[n:] if a["kind"] == "error")
        assert "\n" not in said
        assert len(said) < 600
    for wrong, word in (
        ({"do": "start", "state": {"y": 1.0}}, "no state"),
        ({"do": "start", "parameters": {"d": -1.0}}, "d = -1"),
        ({"do": "start", "parameters": {"dd": 1.0}}, "not a parameter"),
        ({"do": "start", "frequency": 1e6}, "must be from"),
        ({"do": "slice", "plane": ["x", "x"], "ranges": [[0, 1], [0, 1]]}, "twice"),
        ({"do": "slice", "plane": ["x", "w"], "ranges": [[0, 1], [0, 1]]}, "no state"),
        ({"do": "slice", "plane": ["x", "v"], "ranges": [[1, 0], [0, 1]]}, "greater"),
    ):
        assert word in watcher.ask(**wrong)["error"]
    assert watcher.ask(do="start", parameters={"A": 0.2}, state={"x": 0.3})["kind"] == "done"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["whole", "closing", "flow", "slanted"])
def test_settle_cells__ends_where_the_analysis_follows(directories, name):
    """The live page and the analyses name the same attractor for the same initial states."""
    opened = RunDirectory.open(directories[name])
    live, cube, attractors = LiveRun(opened), opened.cube(), derive(directories[name], "attractors")
    rng, n_named = np.random.default_rng(3), 0
    for points in slabs(cube, Dynamics.of(cube), SECTION_BYTES):
        for index, there in destinations_at(cube, attractors, points):
            (axis,) = split_dims(cube["status"])[0]
            place = live.place({axis: float(cube[axis][index[0]])}, None)
            catalog = live.catalog(place)
            starts = rng.uniform(-0.9, 0.9, (64, 2))
            numbers = settle_cells(place, live.integration, catalog, starts, lambda: None)
            labels = there.follow(starts).label
            ends = [catalog.entry(number) for number in numbers.tolist()]
            named = [i for i, end in enumerate(ends) if end.attractor is not None and end.stability == ATTRACTS]
            assert [ends[i].attractor for i in named] == labels[named].tolist()
            n_named += len(named)
    assert n_named > 64
