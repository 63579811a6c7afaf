"""Runs of maps: bifurcations against closed forms, and tables and figures that count iterations."""

from __future__ import annotations

import json

import numpy as np
import pytest
from matplotlib.text import Text
from scipy.optimize import fsolve

import magpend
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.problems import Family
from pipeline.runs.derive import derive, shown_table
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from tests.pipeline.factories import finished

pytestmark = pytest.mark.slow

HENON = """
kind = "sweep"
model = "henon"
axes.a = { values = [-0.1, 0.1, 0.31, 0.5, 0.95] }
initial_conditions = { kind = "list", points = [[0.1, 0.1], [0.0, 0.0]] }
integration = { n_transient = 400, n_keep = 40 }
products.lyapunov = { n_periods = 64, n_blocks = 4 }
"""
DELAYED = """
kind = "sweep"
axes.a = { values = [1.7, 1.8, 1.9] }
initial_conditions = { kind = "list", points = [[0.3, 0.3]] }
integration = { n_transient = 600, n_keep = 40 }

[model]
name = "delayed"
kind = "map"
states = { x = {}, y = {} }
parameters = { a = 2.0 }
equations = { x = "a*x*(1 - y)", y = "x" }
"""
BALL = """
kind = "sweep"
axes.gamma = { values = [3.5, 3.7] }
initial_conditions = { kind = "grid", phi = { start = -3.0, stop = 3.0, num = 12 }, v = { values = [6.0, 6.4] } }
integration = { n_transient = 1500, n_keep = 40 }

[model]
name = "ball"
kind = "map"
states = { phi = { unit = "rad", on_circle = true }, v = {} }
parameters = { alpha = 0.5, gamma = 3.5 }
define = { next = "phi + v" }
equations = { phi = "next", v = "alpha*v - gamma*cos(next)" }
"""
"""Bouncing ball: Holmes, J. Sound Vib. 84 (1982) 173-189, the high-bounce map."""

LOGISTIC = magpend.model("x' = r*x*(1 - x)", kind="map", r=3.2)


def located(run, low, high, parameter, **options):
    """Return the located bifurcations as rows: parameter value, type, period and critical multiplier."""
    ds = derive(run, "branches", {"parameter": parameter, "low": low, "high": high, **options})
    rows = zip(
        ds[f"bifurcation_{parameter}"].values,
        [str(kind) for kind in np.array(ds["kind"].attrs["flag_meanings"].split())[ds["kind"].values]],
        ds["orbit_period"].values[ds["of_branch"].values],
        ds["critical_real"].values + 1j * ds["critical_imag"].values,
        strict=True,
    )
    return sorted((float(v), k, int(p), complex(m)) for v, k, p, m in rows)


@pytest.fixture(scope="module")
def henon(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("henon"), HENON)


def test_henon__fold_and_doublings(henon):
    """With b = .3: fold at -(1 - b)**2/4; doublings at 3 (1 - b)**2/4, and at (1 - b)**2 + (1 + b)**2/4 of period 2."""
    found = located(henon, -0.2, 0.95, "a", max_period=2)
    wanted = [(-0.1225, "fold", 1), (0.3675, "period_doubling", 1), (0.9125, "period_doubling", 2)]
    assert [row[1:3] for row in found] == [row[1:] for row in wanted]
    assert [row[0] for row in found] == pytest.approx([row[0] for row in wanted], abs=1e-10)


def test_delayed_logistic__neimark_sacker(tmp_path):
    """At a = 2, with multipliers exp(+-i pi/3)."""
    ((value, kind, period, multiplier),) = located(finished(tmp_path, DELAYED), 1.7, 2.1, "a")
    assert (kind, period) == ("neimark_sacker", 1)
    assert value == pytest.approx(2.0, abs=1e-10)
    assert abs(np.angle(multiplier)) == pytest.approx(np.pi / 3.0, abs=1e-9)


def test_bouncing_ball__fold_and_doubling(tmp_path):
    """Of one bounce per turn of the table: cos phi = -2 pi (1 - alpha)/gamma; fold where that is -1, doubling where
    gamma**2 = (2 pi (1 - alpha))**2 + 4 (1 + alpha)**2.
    """
    run = finished(tmp_path, BALL)
    folds = [row[0] for row in located(run, 3.0, 4.5, "gamma", max_period=1) if row[1] == "fold"]
    doublings = [row[0] for row in located(run, 3.0, 4.5, "gamma", max_period=1) if row[1] == "period_doubling"]
    assert folds == pytest.approx([np.pi], abs=1e-10)
    assert doublings[:1] == pytest.approx([np.hypot(np.pi, 3.0)], abs=1e-10)


def test_logistic__cascade(tmp_path):
    """Doublings at 3 and 1 + sqrt(6); their limit, by Aitken's rule from the last three, is 3.569945672."""
    spec = (
        Spec("sweep", LOGISTIC)
        .with_axis("r", values=[2.9, 3.2, 3.5, 3.55, 3.566, 3.5693, 3.56976])
        .with_start_list([[0.3]])
        .with_integration(n_transient=6000, n_keep=300, max_orbit_period=64)
    )
    rows = located(magpend.run(spec, tmp_path / "run", workers=0), 2.9, 3.5699, "r", max_period=64)
    doublings = [value for value, kind, _, _ in rows if kind == "period_doubling"]
    assert [row[2] for row in rows if row[1] == "period_doubling"] == [2**k for k in range(len(doublings))]
    assert doublings[:2] == pytest.approx([3.0, 1.0 + np.sqrt(6.0)], abs=1e-10)
    assert len(doublings) >= 6
    a, b, c = doublings[-3:]
    assert c - (c - b) ** 2 / ((c - b) - (b - a)) == pytest.approx(3.569945672, abs=1e-6)


def logistic(folder, values, model=LOGISTIC):
    """Return a run of the logistic map at some values of r, long enough to settle apart from bifurcations."""
    spec = magpend.Spec("sweep", model).with_axis("r", values=values).with_start_list([[0.3]])
    return magpend.run(spec.with_integration(n_transient=4000, n_keep=60, max_orbit_period=16), folder, workers=0)


@pytest.mark.usefixtures("long_steps")
def test_logistic__grid_values_on_bifurcations(tmp_path):
    """Cells at r = 1 and 3 end on an orbit of twice the period, but for their error: each branch is there once."""
    for values, ends, known, periods in (
        ([1.0, 2.0, 3.0], (0.5, 3.2), {"transcritical": 1.0, "period_doubling": 3.0}, [1, 1, 2]),
        ([3.0], (2.9, 3.1), {"period_doubling": 3.0}, [1, 2]),
    ):
        ds = logistic(tmp_path / str(len(values)), values).branches(parameter="r", low=ends[0], high=ends[1])
        rows = shown_table("branches", ds).rows
        assert sorted(ds["orbit_period"].values) == periods
        assert [(row["type"], row["period"]) for row in rows] == [(kind, 1) for kind in known]
        # where branches cross Newton's method is as exact as the root of its residual
        assert [row["r"] for row in rows] == pytest.approx(list(known.values()), abs=1.5e-7)
        assert rows[-1]["r"] == pytest.approx(3.0, abs=1e-8)


def test_logistic__normal_form_of_a_two_cycle():
    """At r = 1 + sqrt(6) the coefficient of its doubling is 70 + 20 sqrt(6), whichever point of it comes first."""
    r = 3.4
    root = np.sqrt((r + 1.0) * (r - 3.0))
    for x in (r + 1.0 + root, r + 1.0 - root):
        family = Family(LOGISTIC.system, 2, 1.0, LOGISTIC.load(r=r).pack(), ("r",), (1.0,))
        branches = explore([Start(family, np.array([x / (2.0 * r)]), r)], Scope(3.3, 3.5, 2, max_generations=1))
        (one,) = [one for branch in branches for one in branch.bifurcations]
        assert one.coefficient == pytest.approx(70.0 + 20.0 * np.sqrt(6.0), rel=1e-7)


def test_logistic__orbits_near_a_start(tmp_path, command):
    """At r = 4 the orbit of period 3 through sin(pi/7)^2 has the multiplier 2^3; x = 3/4 has -2."""
    run = logistic(tmp_path / "run", [4.0])
    near = {"starts": 2, "max_period": 1, "rounds": 0}
    ds = run.orbits(start={"x": 0.188}, start_period=3, **near)
    one = ds.isel(orbit=int(ds.attrs["start_orbit"]))
    assert (int(one["orbit_period"]), int(one["n_hits"])) == (3, 0)
    found = np.sort(one["section"].values[:, 0])
    np.testing.assert_allclose(found, np.sin(np.pi * np.array([1.0, 2.0, 3.0]) / 7.0) ** 2, atol=1e-10)
    np.testing.assert_allclose(one["multiplier_real"], 8.0, atol=1e-7)
    ds = run.orbits(start={"x": 0.74}, **near)
    one = ds.isel(orbit=int(ds.attrs["start_orbit"]))
    np.testing.assert_allclose([one["section"].values[0, 0], one["multiplier_real"].values[0]], [0.75, -2.0], atol=1e-9)
    words = ("--start", "x=0.188", "--start-period", "3", "--period", "1")
    out, _ = command(tmp_path, "analyse", "orbits", tmp_path / "run", *words)
    assert "--start: leads to orbit" in out
    for options, told in (({"y": 1.0}, "missing: x"), ({"x": 0.5}, "1 or more")):
        with pytest.raises(SpecError, match=told):
            run.orbits(start=options, start_period=int("y" in options))


TWICE = magpend.model("x' = r*y*(1 - y)", define={"y": "r*x*(1 - x)"}, kind="map", r=3.2)
"""The logistic map taken twice. It maps an orbit to its mirror image: doublings of odd periods become pitchforks."""


def test_twice__pitchfork_that_turns_sharply(tmp_path):
    """Steps across the tips of the broken orbits lead to the symmetric one: a branch must not go on there."""

    def doubling(x):
        z, slope = x[0], 1.0
        for _ in range(3):
            slope *= x[1] * (1.0 - 2.0 * z)
            z = x[1] * z * (1.0 - z)
        return [z - x[0], slope + 1.0]

    run = logistic(tmp_path / "run", [3.83, 3.8425], TWICE)
    known = fsolve(doubling, [0.5, 3.8415], xtol=1e-13)[1]
    ds = run.branches(low=3.82, high=3.848, max_period=3)
    table = shown_table("branches", ds)
    (fold, pitchfork, *doublings) = table.rows
    assert [row["type"] for row in table.rows] == ["fold", "pitchfork", "period_doubling", "period_doubling"]
    assert fold["r"] == pytest.approx(1.0 + np.sqrt(8.0), abs=1e-8)
    assert pitchfork["r"] == pytest.approx(known, abs=1e-8)
    assert pitchfork["criticality"] == "supercritical"
    assert doublings[0]["r"] == pytest.approx(doublings[1]["r"], abs=1e-8)
    assert ds.sizes["branch"] == 2
    assert sum("and back by mirror images" in line for line in table.lines) == 1


def texts(panels):
    return " ".join(text.get_text() for text in np.atleast_1d(panels)[0].figure.findobj(Text))


@pytest.mark.usefixtures("long_steps")
def test_words__count_iterations(henon, command, tmp_path):
    """Neither table nor figure of a map names seconds, hertz or a drive."""
    run = magpend.Run.open(henon)
    cube = run.cube()
    assert "frequency" not in cube.coords
    assert cube["lyapunov"].attrs["units"] == "1"
    assert "iteration" in cube["lyapunov"].attrs["long_name"]
    said = [command(tmp_path, "analyse", name, henon)[0] for name in ("attractors", "chaos", "branches")]
    said += [texts(getattr(run.plot, name)()) for name in ("lyapunov", "bifurcation", "branches")]
    said += [texts(run.plot.convergence(at={"a": 0.5}))]
    said += [" ".join(map(str, json.loads(command(tmp_path, "analyse", "branches", henon, "--json")[0])[0]))]
    for text in said:
        assert not {"Hz", "drive", "second", "seconds", "period_s", "[1/s]"} & set(text.split())
    assert "exponents per iteration" in said[1]
    assert "[1/iteration]" in said[3]
    assert "[1/iteration]" in said[6]


def test_refusals__one_sentence_each(henon, tmp_path, command):
    for words in (("simulate", "--model", "henon"), ("animate", henon), ("plot", "gallery", henon, "--at", "a=0.5")):
        with pytest.raises(AssertionError, match="henon is a map"):
            command(tmp_path, *words)
    with pytest.raises(SpecError, match="response follows the motion between section points, and"):
        derive(henon, "response", {})
    tables = {
        "section": {"of": "x"},
        "noise": {"strengths": {"x": 0.1}},
        "drift": {"b": {"from": 0.2, "to": 0.3, "start_periods": 4, "duration_periods": 3}},
        "parameters": {"frequency_hz": 2.0},
        "integration": {"rtol": 1e-6, "max_steps_per_period": 7},
        "products": {"extremes": {"quantities": ["x"]}},
    }
    spec = {"kind": "sweep", "model": "henon", "initial_conditions": {"kind": "list", "points": [[0.1, 0.1]]}, **tables}
    with pytest.raises(SpecError) as raised:
        Spec.parse(spec)
    keys = {problem.partition(":")[0] for problem in raised.value.problems}
    assert keys == {
        "section",
        "noise",
        "drift",
        "parameters.frequency_hz",
        "integration.rtol",
        "integration.max_steps_per_period",
        "products.extremes",
    }
