"""Events of attractors against closed forms, a harmonic balance of the tests' own, and published values."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve

import magpend
from pipeline.analysis.branches.kinds import KINDS
from pipeline.analysis.events.analysis import parts_of
from pipeline.analysis.events.cascades import cascade_of
from pipeline.analysis.events.crises import Crisis
from pipeline.analysis.events.lines import Fate, Line, bifurcation_at, crossing_at, follow, lines_of
from pipeline.analysis.events.one_event import on_circle, same_as, with_images
from pipeline.analysis.events.scene import Event, Stretch
from pipeline.layout.own_words import with_plain_names
from pipeline.layout.vocabulary import KINDS as SETS
from pipeline.results.ragged import ROW_SIZE
from pipeline.results.sets import Geometry
from pipeline.specification.problems import SpecError

CUBIC = magpend.model("x' = mu*x - x**3", name="cubic", kind="map", mirror={"signs": {"x": -1}}, mu=0.5)
LOGISTIC = magpend.model("x' = r*x*(1 - x)", name="logistic", kind="map", r=3.2)
HENON = magpend.model("x' = 1 - a*x**2 + y\ny' = b*x", name="henon", kind="map", a=0.2, b=0.3)
DELAYED = magpend.model("x' = a*x*(1 - y)\ny' = x", name="delayed", kind="map", a=1.9)
SOFT = magpend.model("x'' = mu*x' - x**2*x' - x", name="soft", mu=0.1)
HARD = magpend.model(
    "x' = mu*x - y + x*R - x*R**2\ny' = x + mu*y + y*R - y*R**2\nR = x**2 + y**2", name="hard", mu=-0.1
)
CIRCLE = magpend.model(
    "x' = x*(1 - R) - y*(mu + x)\ny' = y*(1 - R) + x*(mu + x)\nR = x**2 + y**2", name="circle", mu=1.1
)
EXCHANGE = magpend.model("x' = x + mu*x - x**2", name="exchange", kind="map", mu=0.2)
DUFFING = magpend.model("x'' = F*cos(omega*t) - c*x' - x - x**3", name="duffing", F=0.1, c=0.1)

SUPER, SUB = "supercritical", "subcritical"
ROOT = np.sqrt(6.0)


def belt_end(zeta=0.05, mu=0.5, v0=0.5):
    """Velocity of the belt at which a slip from where the mass lets go ends there again, along the belt."""

    def gap(belt):
        def rates(_, y):
            return [y[1], mu * (1.0 + np.exp((y[1] - belt) / v0)) - y[0] - 2.0 * zeta * y[1]]

        def fastest(t, y):
            return rates(t, y)[1] if t > 1.0 else -1.0

        fastest.terminal, fastest.direction = True, -1.0
        start = [2.0 * mu - 2.0 * zeta * belt, belt]
        return solve_ivp(rates, (0.0, 50.0), start, "DOP853", events=fastest, rtol=1e-12, atol=1e-13).y[1, -1] - belt

    return brentq(gap, 1.82, 1.85, xtol=1e-12)


def lorenz_connection(level=7.5):
    """Value of rho at which the unstable manifold of the origin ends on the saddle cycle.

    Its fifth section point has no component along the left eigenvector of the cycle's unstable multiplier.
    """

    def rates(_, u, rho):
        x, y, z = u[:3]
        own = np.array([10.0 * (y - x), x * (rho - z) - y, x * y - 8.0 / 3.0 * z])
        jacobian = np.array([[-10.0, 10.0, 0.0], [rho - z, -1.0, -x], [y, x, -8.0 / 3.0]])
        return np.append(own, jacobian @ u[3:].reshape(3, -1)) if len(u) > 3 else own

    def sections(start, rho, n):
        def crossed(t, u, _):
            return u[0] - level if t > 1e-3 else 1.0

        crossed.terminal, crossed.direction = n, 1.0
        tight = {"rtol": 1e-12, "atol": 1e-14}
        found = solve_ivp(rates, (0.0, 60.0), start, "DOP853", events=crossed, args=(rho,), **tight)
        return np.array(found.y_events[0])

    def clearance(rho):
        point = np.array([9.46, 19.52])
        for _ in range(8):
            (end,) = sections(np.concatenate([[level], point, np.eye(3).ravel()]), rho, 1)
            tangents, rate = end[3:].reshape(3, 3), rates(0.0, end[:3], rho)
            matrix = (tangents - np.outer(rate, tangents[0]) / rate[0])[1:, 1:]
            point = point - np.linalg.solve(matrix - np.eye(2), end[1:3] - point)
        multipliers, left = np.linalg.eig(matrix.T)
        w = left[:, np.abs(multipliers).argmax()]
        unstable = 0.5 * (np.sqrt(121.0 + 40.0 * (rho - 1.0)) - 11.0)
        manifold = sections(-1e-6 * np.array([1.0, 1.0 + unstable / 10.0, 0.0]), rho, 5)
        return (manifold[4, 1:] - point) @ (w / w[0])

    return brentq(clearance, 24.057, 24.059, xtol=1e-11)


KNOWN = {
    # pitchfork of 0 at 1 onto +-sqrt(mu - 1), whose multiplier 3 - 2 mu is -1 at 2: arms that are mirror images have
    # one event, and so have an orbit and what is born of it; the orbit +-x of period 2 with
    # x**2 = mu + 1 is unstable and shrinks onto 0 at -1
    "cubic": [
        ("A", 1, "falls", "period_doubling", SUB, -1.0),
        ("A", 1, "rises", "pitchfork", SUPER, 1.0),
        ("B", 1, "rises", "period_doubling", SUPER, 2.0),
    ],
    "henon": [
        ("A", 1, "falls", "fold", "unknown", -0.25 * 0.7**2),
        ("A", 1, "rises", "period_doubling", SUPER, 0.75 * 0.7**2),
        ("A", 2, "rises", "period_doubling", SUPER, 0.7**2 + 0.25 * 1.3**2),
    ],
    # the multipliers of (a - 1)/a have the product a - 1
    "delayed": [("A", 1, "rises", "neimark_sacker", SUPER, 2.0)],
    # 0 and mu exchange their stability, on one id
    "exchange": [("A", 1, "rises", "transcritical", "unknown", 0.0)],
    # of the delayed map, 0 and (a - 1)/a
    "growth": [("A", 1, "rises", "transcritical", "unknown", 1.0)],
    "soft": [("A", 0, "rises", "hopf", SUPER, 0.0)],
    # cycles of the radius R with mu + R - R**2 = 0
    "hard": [("A", 0, "rises", "hopf", SUB, 0.0), ("B", 1, "falls", "fold", "unknown", -0.25)],
    # on the circle theta' = mu + cos theta: one event, of the equilibrium and of the cycle
    "circle": [("A", 0, "rises", "snic", "unknown", 1.0)],
    # where the slope of the friction is the damping: mu/v0 exp(-belt/v0) = 2 zeta
    "belt": [
        ("A", 1, "rises", "grazing_sliding", "unknown", belt_end),
        ("B", 0, "falls", "hopf", SUB, 0.5 * np.log(10.0)),
    ],
    # sigma (sigma + b + 3)/(sigma - b - 1)
    "lorenz": [
        ("A", 0, "rises", "hopf", SUB, 10.0 * (10.0 + 8.0 / 3.0 + 3.0) / (10.0 - 8.0 / 3.0 - 1.0)),
        ("D", 0, "falls", "boundary_crisis", "unknown", lorenz_connection),
    ],
}


def sweep(model, folder, starts, integration=(), section=None, **axis):
    spec = magpend.Spec("sweep", model)
    for name, values in axis.items():
        spec = spec.with_axis(name, values=[float(x) for x in values])
    if section is not None:
        spec = spec.with_section(longest=60.0, **section)
    settings = {"n_transient": 300, "n_keep": 4, **dict(integration)}
    spec = spec.with_start_random(n=8, seed=0, **starts).with_integration(**settings)
    return magpend.run(spec, folder / "run", workers=0)


LONG = {"n_transient": 2000, "n_keep": 100}
BOX = {"x": (-1.0, 1.0)}
RUNS = {
    "cubic": lambda d: sweep(CUBIC, d, BOX, LONG, mu=np.linspace(-1.31, 2.21, 23)),
    "henon": lambda d: sweep(HENON, d, {**BOX, "y": (-0.3, 0.3)}, LONG, a=np.linspace(-0.1531, 0.9931, 24)),
    "delayed": lambda d: sweep(
        DELAYED, d, {"x": (0.3, 0.6), "y": (0.3, 0.6)}, {"n_transient": 6000, "n_keep": 400},
        a=[1.711, 1.961, 2.011, 2.021],
    ),
    "exchange": lambda d: sweep(EXCHANGE, d, {"x": (0.001, 0.3)}, LONG, mu=[-0.3, -0.2, -0.1, 0.1, 0.2, 0.3]),
    "growth": lambda d: sweep(
        DELAYED, d, {"x": (0.01, 0.3), "y": (0.01, 0.3)}, LONG, a=[0.85, 0.9, 0.95, 1.03, 1.06, 1.11]
    ),
    "soft": lambda d: sweep(
        SOFT, d, {"x": (-2, 2), "x_dot": (-2, 2)}, section={"of": "x_dot", "value": 0.0, "direction": "down"},
        mu=np.linspace(-0.19, 0.41, 7),
    ),
    "hard": lambda d: sweep(
        HARD, d, {"x": (-1.5, 1.5), "y": (-1.5, 1.5)}, section={"of": "y", "value": 0.0, "direction": "up"},
        mu=np.linspace(-0.41, 0.19, 7),
    ),
    "circle": lambda d: sweep(
        CIRCLE, d, {"x": (-1.5, 1.5), "y": (-1.5, 1.5)}, section={"of": "y", "value": 0.0, "direction": "up"},
        mu=[0.7, 0.9, 1.1, 1.3],
    ),
    "belt": lambda d: sweep(
        magpend.load_model("belt-stick"), d, {"x": (-2, 2), "v": (0, 2)}, {"n_transient": 200},
        section={"of": "v", "value": 0.0, "direction": "up"}, belt=[1.1, 1.2, 1.8, 1.85],
    ),
    "lorenz": lambda d: sweep(
        magpend.load_model("lorenz"), d, {"x": (7, 9), "y": (7, 9), "z": (20, 26)}, {"n_transient": 200, "n_keep": 60},
        section={"of": "x", "value": 7.5, "direction": "up"}, rho=[20.0, 22.0, 24.0, 26.0],
    ),
}  # fmt: skip


def told(table):
    """The decided events of a table, as in `KNOWN`, and the largest error in units of the stated one."""
    rows = table[~table["what"].isin(["range_end", "not_decided"])]
    ways = np.where(rows["rises"] == 1, "rises", "falls")
    letters = [chr(ord("A") + i) for i in rows["attractor"]]
    columns = (letters, rows["period"], ways, rows["what"], rows["criticality"])
    (error, _) = [column for column in rows if column.endswith("_error")]
    return list(zip(*columns, strict=True)), rows[error.removesuffix("_error")].to_numpy(), rows[error].to_numpy()


@pytest.mark.slow
@pytest.mark.usefixtures("long_steps")
# matching tries orbits that do not return
@pytest.mark.filterwarnings("ignore:invalid value encountered in det:RuntimeWarning")
@pytest.mark.parametrize("name", RUNS)
def test_events__closed_forms(name, tmp_path):
    run = RUNS[name](tmp_path)
    table = run.table("events")
    events, values, errors = told(table)
    assert sorted(events) == sorted(one[:5] for one in KNOWN[name])
    known = {one[:5]: one[5]() if callable(one[5]) else one[5] for one in KNOWN[name]}
    assert (np.abs(values - [known[one] for one in events]) <= errors).all()
    assert (errors < (4e-7 if name in ("cubic", "exchange", "growth") else 2e-8)).all()
    assert not (table["what"] == "not_decided").any(), table["evidence"].tolist()
    # unstable parts of branches tell nothing that these events need
    full, brief = run.branches(), run.branches(stable=True)
    stable = run.table("events", orbits=name == "lorenz")  # whose crisis rests on no branch
    assert told(stable)[0] == [one for one in events if name != "lorenz" or one[3] != "boundary_crisis"]
    assert int(brief["n_points"].sum()) < int(full["n_points"].sum()) + (
        name in ("delayed", "soft", "lorenz", "circle")
    )


@pytest.mark.slow
def test_events__two_saddle_nodes_on_a_circle(tmp_path):
    """th' = I + cos(2 th): both appear at I = 1, and the cycle's period is 2 pi/sqrt(I**2 - 1)."""
    angle = {"th": {"unit": "rad", "on_circle": True}}
    model = magpend.model("th' = I + cos(2*th)", name="two-rests", states=angle, I=1.05)
    section = {"of": "th", "value": 0.3}
    run = sweep(model, tmp_path, {"th": (-3.0, 3.0)}, {"n_transient": 30}, section=section, I=[0.9, 0.95, 1.05, 1.1])
    (told,) = [row for row in run.table("events")["sentence"] if "reaches the end" not in row]
    assert told.startswith("A (equilibrium) ends at I = 1.0000000000 ± ")
    assert told.endswith("where C (period 1) begins and B (equilibrium) ends too; its cells go on to C")
    located = run.branches()
    for name, tolerance in (("limit_slope", 2e-3), ("limit_slope_expected", 1e-6)):
        (slope,) = located[name].values[np.isfinite(located[name].values)]
        assert slope == pytest.approx(np.sqrt(2.0) * np.pi, rel=tolerance)


@pytest.mark.slow
@pytest.mark.usefixtures("long_steps")
def test_events__saddle_node_on_a_circle_at_a_value_of_the_run(tmp_path):
    """th' = I - sin(th): one event at I = 1, where no cell ends on an attractor; cells go on to the cycle."""
    angle = {"th": {"unit": "rad", "on_circle": True}}
    adler = magpend.model("th' = I - sin(th)", name="adler", states=angle, I=1.05)
    values, section = np.linspace(0.9, 1.1, 9), {"of": "th", "value": 3.0}
    run = sweep(adler, tmp_path, {"th": (-3.0, 3.0)}, {"n_transient": 30}, section=section, I=values)
    (told,) = [row for row in run.table("events")["sentence"] if "reaches the end" not in row]
    assert told.startswith("A (equilibrium) ends at I = 1.0000000000 ± ")
    assert told.endswith(", where B (period 1) begins; its cells go on to B")


@pytest.mark.slow
@pytest.mark.usefixtures("long_steps")
@pytest.mark.parametrize("name", ["circle", "logistic"])
def test_events__seen_at_the_very_value_of_a_bifurcation(name, tmp_path):
    """There cells end on the orbit of the bifurcation, with an id or a period of its own: it is no third attractor."""
    section = {"of": "y", "value": 0.0, "direction": "up"}
    if name == "circle":
        starts = {"x": (-1.5, 1.5), "y": (-1.5, 1.5)}
        run = sweep(CIRCLE, tmp_path, starts, section=section, mu=[0.8, 0.9, 1.0, 1.1, 1.2])
        known, value = [("A", 0, "rises", "snic", "unknown")], 1.0
    else:
        run = sweep(LOGISTIC, tmp_path, {"x": (0.1, 0.9)}, LONG, r=[2.9, 3.0, 3.1, 3.2])
        known, value = [("A", 1, "rises", "period_doubling", SUPER)], 3.0
    table = run.table("events")
    events, values, errors = told(table)
    assert events == known
    assert abs(values[0] - value) <= errors[0]
    assert not (table["what"] == "not_decided").any(), table["evidence"].tolist()
    assert table["seen"][table["what"] == known[0][3]].tolist() == [value]


def line_to_fold(value=1.0, state=0.0):
    """A stable line up to a fold, as a parabola, and the located branches with the fold."""
    points = state + np.array([-0.2, -0.1, 0.0, 0.1])[:, None, None]
    line = Line(0, 1, value - points[:, 0, 0] ** 2, points, np.array([-1, -1, 0, -1]), np.array([0, 0, -1, 1]),
                np.array([True, True, False]), ("bound", "bound"))  # fmt: skip
    columns = {"kind": [KINDS.index("fold")], "bracket": [1e-10], "value": [value]}
    return line, xr.Dataset({key: ("bifurcation", found) for key, found in columns.items()})


def test_bifurcation_at__values_within_the_error_and_all_points_of_the_orbit():
    (line, ds), geometry = line_to_fold(), Geometry((False,), (1.0,))
    at_fold = partial(bifurcation_at, ds, line, geometry=geometry, scale=0.4)
    found = at_fold(1.0 + 1e-10, np.array([[1e-5]]))
    assert found[1] == 1
    assert [follow(ds.assign_attrs(parameter="mu"), found, way).bifurcation for way in (-1, 1)] == [-1, 0]
    assert at_fold(1.0 + 1e-8, np.array([[1e-5]])) is None  # another value
    assert at_fold(1.0, np.array([[1e-5], [0.1]])) is None  # an orbit that has other points too
    unstable = replace(line, is_stable=np.zeros(3, bool))
    assert bifurcation_at(ds, unstable, 1.0, np.array([[0.0]]), geometry, 0.4) is None


def test_on_circle__compares_values_sides_and_states():
    """A fold elsewhere in space, at the value of a saddle node on a circle, is another event."""
    ds = xr.Dataset({
        "bifurcation_section": (("bifurcation", "phase", "state"), [[[0.0, 1.0]], [[0.0, -1.0]]]),
        "limit_state": (
            ("branch", "end", "rest", "state"),
            [[[[np.nan] * 2] * 2] * 2, [[[5.0, 0.0], [1e-9, 1.0]], [[np.nan] * 2] * 2]],
        ),
    })  # fmt: skip
    attractors = xr.Dataset(attrs={"model": magpend.load_model("duffing").name})
    scene = SimpleNamespace(located=ds, attractors=attractors)
    rest, turns = Stretch(0, SETS.index("equilibrium"), 0, (0, 1), (0, 1)), Stretch(1, 1, 1, (2, 3), (2, 3))
    fold = Event(rest, True, Fate(1.0, 0, 5, 0), "fold", 1e-10)
    cycle = Event(turns, False, Fate(1.0 + 1e-10, 1, 0, limit="snic", error=1e-10), "snic", 1e-10)
    assert on_circle(scene, fold, cycle)
    assert not on_circle(scene, replace(fold, fate=replace(fold.fate, bifurcation=1)), cycle)
    assert not on_circle(scene, replace(fold, fate=replace(fold.fate, value=1.1)), cycle)
    assert not on_circle(scene, replace(fold, rises=False), cycle)
    assert not on_circle(scene, cycle, fold)


def test_same_as__joins_rests_by_the_cycle_on_which_they_lie():
    """Neither equilibrium is the other one; the cycle that comes last makes one event of all three."""
    ds = xr.Dataset({
        "of_branch": ("bifurcation", [0, 2]),
        "bifurcation_section": (("bifurcation", "phase", "state"), [[[0.0, 1.0]], [[0.0, -1.0]]]),
        "limit_state": (("branch", "end", "rest", "state"), np.tile([[0.0, 1.0], [0.0, -1.0]], (3, 2, 1, 1))),
    })  # fmt: skip
    attractors = xr.Dataset({"attractor": ("set", [0, 1, 2])}, attrs={"model": magpend.load_model("duffing").name})
    scene = SimpleNamespace(located=ds, attractors=attractors)
    rests = [
        Event(Stretch(k, SETS.index("equilibrium"), 0, (0, 1), (k, k)), True, Fate(1.0, 2 * k, 5, k), "snic", 1e-10)
        for k in (0, 1)
    ]
    turns = Stretch(2, 1, 1, (2, 3), (2, 2))
    cycle = Event(turns, False, Fate(1.0, 1, 0, limit="snic", error=1e-10), "snic", 1e-10)
    assert same_as(scene, [*rests, cycle]) == [0, 0, 0]
    assert same_as(scene, rests) == [0, 1]


def cut_at(along, up, down):
    """Values of the parts of one stretch, given the fates of its first and its last orbit as these rise and fall."""
    places = range(len(along))
    sets = {"attractor": ("set", [0] * len(along)), ROW_SIZE: ("mu", [1] * len(along))}
    scene = SimpleNamespace(along=np.array(along), scale=np.ptp(along), order=np.array(places), attractors=None)
    scene.attractors = xr.Dataset(sets)
    one, end = Stretch(0, 0, 0, (0, places[-1]), (0, places[-1])), Fate(np.nan, 7, is_bound=True)
    fates = {(one, False): (replace(end, branch=up.branch), up), (one, True): (down, replace(end, branch=down.branch))}
    known, others = parts_of(scene, one, fates)
    cut = [part.places for part, _ in known], [part.places for part in others]
    assert all(part.rows == part.places for part in [*(part for part, _ in known), *others])
    return cut


def test_parts_of__an_id_over_two_stable_pieces():
    """They meet at 0, between two values or at one; apart, what lies between is asked anew; else both halves are."""
    left, right = Fate(0.0, 1, 3, 0), Fate(0.0, 2, 4, 0)
    whole, half = [-0.3, -0.1, 0.1, 0.3], [-0.2, 0.0, 0.2, 0.3]
    assert cut_at(whole, left, right) == ([(0, 1), (2, 3)], [])
    assert cut_at(half, left, right) == ([(0, 1), (2, 3)], [])
    assert cut_at(whole, replace(left, value=-0.2), right) == ([(0, 0), (2, 3)], [(1, 1)])
    assert cut_at(whole, replace(left, value=0.2), replace(right, value=-0.2)) == ([], [(0, 1), (2, 3)])
    assert cut_at(whole, replace(left, value=0.5), replace(right, value=-0.5)) == ([], [(0, 1), (2, 3)])
    # the last orbit lies on no branch; a bifurcation beyond the range; nothing known
    assert cut_at(whole, left, Fate(np.nan)) == ([(0, 1)], [(2, 3)])
    assert cut_at(whole, Fate(0.4, 1, 3, 0), Fate(np.nan)) == ([(0, 3)], [])
    assert cut_at(whole, Fate(np.nan), Fate(np.nan)) == ([(0, 3)], [])


@pytest.mark.parametrize("set_", ["periodic_orbit", "chaotic_set"])
def test_with_images__gives_mirror_images_one_verdict(set_):
    """A twin whose branch is not found ends as its image does: where both have cells, also if the image is seen on."""
    partners = [1, 0, -1, 1, 0, -1, 1, 0, -1]  # three values, with the attractors A, its image B, and C
    columns = {"attractor": [0, 1, 2] * 3, "mirror_partner": partners, "mirror_distance": [1e-9] * 9}
    scene = SimpleNamespace(attractors=xr.Dataset({name: ("set", v) for name, v in columns.items()}), names={})
    kind, period = SETS.index(set_), 5 if set_ == "periodic_orbit" else 0

    def end(number, place, **more):
        one = Stretch(number, kind, period, (0, place), (number, 3 * place + number))
        return Event(one, True, Fate(np.nan if not more else 0.3, why="by it"), to={7: number}, **more)

    known = {"what": "period_doubling", "error": 1e-9}
    found = with_images(scene, [end(0, 1), end(1, 1, **known), end(2, 1)])
    assert [one.what for one in found] == ["period_doubling", "period_doubling", "not_decided"]
    assert (found[0].fate.value, found[0].error, found[0].fate.why) == (0.3, 1e-9, "of its mirror image: by it")
    assert found[0].to == {7: 0}
    later = with_images(scene, [end(0, 1), end(1, 2, **known)])
    assert (later[0].what == "period_doubling") == (set_ == "periodic_orbit")
    assert with_images(scene, [end(0, 1), end(1, 0, **known)])[0].what == "not_decided"
    assert with_images(scene, [end(0, 1), end(1, 1, what="range_end")])[0].what == "not_decided"
    merged = end(1, 1, what="attractor_merging", error=1e-9, born=Crisis("attractor_merging", "", twin=0))
    assert with_images(scene, [end(0, 1), merged])[0].born.twin == 1
    falls = replace(end(1, 1, **known), rises=False)
    assert with_images(scene, [end(0, 1), falls])[0].what == "not_decided"


def test_with_images__leaves_orbits_that_are_no_images():
    """A partner is the nearest attractor, and it may be another orbit."""
    columns = {"attractor": [0, 1], "mirror_partner": [1, 0], "mirror_distance": [0.1, 0.1]}
    scene = SimpleNamespace(attractors=xr.Dataset({name: ("set", v) for name, v in columns.items()}), names={})
    ends = [Stretch(k, SETS.index("periodic_orbit"), 1, (0, 0), (k, k)) for k in (0, 1)]
    named = [Event(ends[0], True, Fate(np.nan)), Event(ends[1], True, Fate(0.3), "fold", 1e-9)]
    assert with_images(scene, named)[0].what == "not_decided"


@pytest.mark.slow
def test_events__cascade_of_the_logistic_map(tmp_path):
    run = sweep(
        LOGISTIC, tmp_path, {"x": (0.1, 0.9)}, {"n_transient": 4000, "n_keep": 200}, r=np.linspace(2.801, 3.575, 101)
    )
    table = run.table("events")
    events, values, errors = told(table)
    found = dict(zip(events, zip(values, errors, strict=True), strict=True))
    doublings = [found["A", p, "rises", "period_doubling", SUPER] for p in (1, 2)]
    assert [x for x, _ in doublings] == pytest.approx([3.0, 1.0 + ROOT], abs=1e-9)
    ((limit, error),) = (v for k, v in found.items() if k[3] == "cascade")
    assert abs(limit - 3.569945671870945) < error < 1e-6  # OEIS A098587
    assert not (table["what"] == "not_decided").any()
    assert [one[:3] for one in events] == [("A", p, "rises") for p in (1, 2, 4, 8, 16)] + [("B", 0, "falls")]
    # the same cascade says nothing of a set that is seen beyond the merging of its bands, as crises may lie between
    located = with_plain_names(run.branches())
    first = int(np.flatnonzero(np.abs(located["value"] - 3.0) < 1e-6)[0])
    points = located["bifurcation_section"].values[first, :1]
    born = cascade_of(located, Fate(3.0, 0, 0, first), (3.5, 3.8), points, Geometry((False,), (1.0,)))
    assert born.what == ""
    assert "crises" in born.why


@pytest.mark.slow
def test_crossing_at__needs_both_branches(tmp_path):
    """A pitchfork that is said to be transcritical, or whose other branch is unknown, is a branch point."""
    located = sweep(CUBIC, tmp_path, BOX, LONG, mu=[0.81, 1.21]).branches()
    located = with_plain_names(located)
    lines = lines_of(located, {"mu": 1.0}, Geometry((False,), (1.0,)))
    ((k,),) = np.nonzero(located["kind"].values == KINDS.index("pitchfork"))
    assert crossing_at(located, lines, int(k)) == "pitchfork"
    assert crossing_at(located, lines[:1], int(k)) == "branch_point"
    located["kind"].values[k] = KINDS.index("transcritical")
    assert crossing_at(located, lines, int(k)) == "branch_point"


def fold_of(force, omega, first, n=6):
    """Frequency of a fold of the hardening oscillator, where the Jacobian of a harmonic balance is singular."""
    orders = np.arange(1, 2 * n, 2)
    phases = np.exp(1j * np.outer(np.arange(8 * n) * 2.0 * np.pi / (8 * n), orders))

    def residual(u, w):
        c = u[:n] + 1j * u[n:]
        own = (1.0 - (orders * w) ** 2 + 0.1j * orders * w) * c
        own += 2.0 * (phases.conj().T @ (phases @ c).real ** 3) / (8 * n)
        own[0] -= force
        return np.concatenate([own.real, own.imag])

    def slope(u, w, v):
        # two central differences, whose combination is exact for cubics
        near, far = ((residual(u + h * v, w) - residual(u - h * v, w)) / (2.0 * h) for h in (0.1, 0.2))
        return (4.0 * near - far) / 3.0

    def singular(y):
        u, w, v = y[: 2 * n], y[2 * n], y[2 * n + 1 :]
        return np.concatenate([residual(u, w), slope(u, w, v), [v @ v - 1.0]])

    u = np.zeros(2 * n)
    u[0], u[n] = first.real, first.imag
    u = fsolve(residual, u, args=(omega,))
    matrix = np.column_stack([slope(u, omega, e) for e in np.eye(2 * n)])
    y, _, flag, message = fsolve(singular, [*u, omega, *np.linalg.svd(matrix)[2][-1]], xtol=1e-13, full_output=True)
    assert flag == 1, message
    return float(y[2 * n])


@pytest.mark.slow
@pytest.mark.usefixtures("long_steps")
def test_events__both_folds_of_duffing_in_one_bracket(tmp_path):
    starts = {"x": (-3, 3), "x_dot": (-3, 3)}
    run = sweep(DUFFING, tmp_path, starts, F=[0.05, 0.1], omega=[1.0, 1.1, 1.3, 1.4])
    table = run.table("events", parameter="omega", at={"F": 0.1})
    events, values, errors = told(table)
    assert (errors < 1e-9).all()
    assert events == [("A", 1, "rises", "fold", "unknown"), ("B", 1, "falls", "fold", "unknown")]
    known = [fold_of(0.1, 1.22, 0.4 - 0.7j), fold_of(0.1, 1.16, -0.4 - 0.1j)]
    assert known == pytest.approx([1.228735, 1.157952], abs=1e-6)  # docs/response.md
    assert (np.abs(values - known) <= errors).all()
    assert "fold (LP), it meets the unstable orbit of branch" in table["sentence"].str.cat()
    with pytest.raises(SpecError, match="does not sweep"):
        run.events(parameter="c")
    with pytest.raises(SpecError, match="also has F"):
        run.events(parameter="omega")
    run.branches(parameter="omega", low=1.05, high=1.2)
    with pytest.raises(SpecError, match="fewer than two values"):
        run.events(parameter="omega", at={"F": 0.1})
