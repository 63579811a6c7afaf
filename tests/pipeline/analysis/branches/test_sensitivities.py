"""Derivatives of bifurcations by parameters: closed forms, dimensional analysis, and bifurcations located again."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.analysis.branches.arclength import Settings
from pipeline.analysis.branches.dataset import dataset_of
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.problems import Family
from pipeline.analysis.branches.sensitivities import STATUSES, sensitivities_of, sensitivities_table
from pipeline.layout.own_words import in_own_words, with_plain_names
from pipeline.layout.vocabulary import parameters_of
from pipeline.runs.derive import derive
from pipeline.specification.problems import SpecError
from tests.core.flows import model_of
from tests.pipeline.analysis.branches.test_bands import write_draws
from tests.pipeline.analysis.cubes import swept
from tests.pipeline.bautin import SWEEP, TRUTH

pytestmark = pytest.mark.usefixtures("long_steps_of_a_file")
OMEGA = 2.0 * np.pi


def followed(model, parameter, interval, state, value, *, period=0, max_period=2, step=0.02, hertz=1.0, **overrides):
    """Return the branches from one equilibrium or orbit of a model, and the parameters."""
    parameters, (low, high) = model.load(**overrides), interval
    family = Family(model.system, period, hertz, parameters.pack(), (parameter,), (high - low,))
    scope = Scope(low, high, max_period, settings=Settings(longest_step=step))
    return dataset_of(explore([Start(family, np.array(state, float), value)], scope), parameter, parameters), parameters


def moves(branches, parameters):
    """Return the sensitivities, and the derivatives by kind and value: a dict of parameters each."""
    found = sensitivities_of(branches, parameters)
    kinds = found["kind"].attrs["flag_meanings"].split()
    names = found["parameter"].values.tolist()
    columns = found["kind"].values.tolist(), found["value"].values.tolist(), found["derivative"].values
    rows = [(kinds[k], value, dict(zip(names, by, strict=True))) for k, value, by in zip(*columns, strict=True)]
    rows.sort(key=lambda row: row[1])
    return found, rows


@pytest.mark.slow
def test_fold_of_equilibria():
    """m + a x + c x^2 - b x^3 = 0: for c = 0 folds at x^2 = a/(3 b), m = -+2 a x/3; dm/dc = -x^2."""
    model = model_of({"x": "m + a*x + c*x^2 - b*x^3"}, {"m": 0.0, "a": 3.0, "b": 1.0, "c": 0.0})
    a, b = 2.0, 1.5
    found, rows = moves(*followed(model, "m", (-4.0, 4.0), [1.7], b * 1.7**3 - a * 1.7, a=a, b=b))
    x = np.sqrt(a / (3.0 * b))
    for (kind, value, by), sign in zip(rows, (-1.0, 1.0), strict=True):
        assert kind == "fold"
        assert value == pytest.approx(sign * 2.0 * a * x / 3.0, abs=1e-12)
        assert by == pytest.approx({"a": sign * x, "b": -sign * x**3, "c": -(x**2)}, rel=1e-9)
    np.testing.assert_allclose(found["elasticity"], [[1.5, -0.5, np.nan]] * 2, rtol=1e-9)
    true = np.array([[-x, x**3, -(x**2)], [x, -(x**3), -(x**2)]])[np.argsort(np.argsort(found["value"].values))]
    assert (np.abs(found["derivative"].values - true) <= found["derivative_error"].values + 1e-12).all()


@pytest.mark.slow
def test_hopf():
    """Brusselator: b = 1 + a^2."""
    model = model_of({"x": "a + x^2*y - (b + 1)*x", "y": "b*x - x^2*y"}, {"a": 1.2, "b": 2.0})
    _, rows = moves(*followed(model, "b", (1.5, 3.0), [1.2, 2.0 / 1.2], 2.0, step=0.05))
    by = {kind: (value, by) for kind, value, by in rows}
    assert by["hopf"][0] == pytest.approx(2.44, abs=1e-10)
    assert by["hopf"][1] == pytest.approx({"a": 2.4}, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("right", "kind", "exact"),
    [
        ("(p^3 - a*b)*x - x^3 + e", "pitchfork", (1.0 / 3.0, 1.0 / 3.0)),
        ("(p^3 - a*b^2)*(x - a) - (x - a)^2 + e", "transcritical", (1.0 / 3.0, 2.0 / 3.0)),
    ],
)
def test_branch_points_of_equilibria(right, kind, exact):
    """They lie at p^3 = a b and a b^2, and exist for e = 0 alone."""
    model = model_of({"x": right}, {"p": 0.0, "a": 1.2, "b": 0.5, "e": 0.0})
    rest = 0.0 if kind == "pitchfork" else 1.2
    found, rows = moves(*followed(model, "p", (0.3, 1.5), [rest], 0.35, step=0.05))
    ((_, value, by),) = [row for row in rows if row[0] == kind]
    np.testing.assert_allclose([by["a"] * 1.2 / value, by["b"] * 0.5 / value], exact, rtol=1e-8)
    assert np.isnan(by["e"])
    k = found["kind"].attrs["flag_meanings"].split().index(kind)
    status = found["status"].values[found["kind"].values == k][0]
    assert [STATUSES[s] for s in status] == ["known", "known", "breaks"]
    own = {"deviation": ("bifurcation", np.full(found.sizes["bifurcation"], np.nan))}
    own["parameter_deviation"] = ("parameter", np.zeros(found.sizes["parameter"]))
    assert "it does not survive" in "\n".join(sensitivities_table(found.assign(own)).lines)


@pytest.mark.slow
def test_maps():
    """Henon: fold at -(1-b)^2/4, doublings at 3 (1-b)^2/4 and (1-b)^2 + (1+b)^2/4. Delayed logistic map: r s = 2."""
    henon = model_of({"x": "1 - a*x^2 + y", "y": "b*x"}, {"a": 0.3, "b": 0.3}, kind="map")
    x = (-0.7 + np.sqrt(0.49 + 4.0 * 0.1)) / 0.2
    _, rows = moves(*followed(henon, "a", (-0.2, 1.0), [x, 0.3 * x], 0.1, period=1, max_period=4))
    fold = next(row for row in rows if row[0] == "fold")
    assert [fold[1], fold[2]["b"]] == pytest.approx([-0.49 / 4.0, 0.35], rel=1e-8)
    first, second = [row for row in rows if row[0] == "period_doubling"][:2]
    assert [first[1], first[2]["b"]] == pytest.approx([0.75 * 0.49, -1.5 * 0.7], rel=1e-8)
    assert [second[1], second[2]["b"]] == pytest.approx([0.49 + 1.69 / 4.0, -2.0 * 0.7 + 0.5 * 1.3], rel=1e-8)
    delayed = model_of({"x": "r*s*x*(1 - y)", "y": "x"}, {"r": 1.9, "s": 1.25}, kind="map")
    x = 1.0 - 1.0 / (1.4 * 1.25)
    _, rows = moves(*followed(delayed, "r", (1.3, 1.9), [x, x], 1.4, period=1))
    torus = next(row for row in rows if row[0] == "neimark_sacker")
    assert [torus[1], torus[2]["s"]] == pytest.approx([1.6, -1.6 / 1.25], rel=1e-8)


@pytest.fixture(scope="module")
def hardening(tmp_path_factory):
    """x'' + d x' + k x + c x^3 = F cos(w t) along its frequency: two folds."""
    out, starts = tmp_path_factory.mktemp("hardening") / "run", {"x": (-3, 3), "v": (-3, 3)}
    band = (0.5 / OMEGA, 2.0 / OMEGA, 9)
    return swept("duffing", out, starts, (300, 4), parameters={"preset": "hardening"}, frequency_hz=band)


@pytest.fixture(scope="module")
def folds(hardening):
    return with_plain_names(hardening.sensitivities(deviation={"damping": 0.01, "linear": 0.02}))


@pytest.mark.slow
def test_folds_of_orbits(hardening, folds):
    """Units of time and length change no physics, which gives two sums of elasticities; the rest is located again."""
    by = {str(n): folds["elasticity"].sel(parameter=n).values for n in folds["parameter"].values}
    np.testing.assert_allclose(by["damping"] + 2.0 * (by["linear"] + by["cubic"] + by["amplitude"]), 1.0, rtol=1e-8)
    np.testing.assert_allclose(by["amplitude"], 2.0 * by["cubic"], rtol=1e-8)
    base, steps = 0.1, np.array([-2.0, -1.0, 1.0, 2.0]) * 1e-3
    branches = hardening.branches()
    orbit = branches["section"].values[0, 0, 0]
    at = float(branches["frequency"].values[0, 0])
    own = parameters_of(hardening.cube())
    places = []
    for step in steps:
        found, _ = followed(
            own.model, "frequency", (0.5 / OMEGA, 2.0 / OMEGA), orbit, at, period=1, **{**own, "damping": base + step}
        )
        places.append(np.sort(found["value"].values))
    located = np.array([1.0, -8.0, 8.0, -1.0]) @ np.array(places) / 12e-3
    derivative = folds["derivative"].sel(parameter="damping").values[np.argsort(folds["value"].values)]
    np.testing.assert_allclose(derivative, located, rtol=1e-5)
    parts = folds["derivative"].sel(parameter=["damping", "linear"]).values * [0.01, 0.02]
    np.testing.assert_allclose(folds["deviation"], np.hypot(*parts.T), rtol=1e-14)


@pytest.mark.slow
def test_words_of_the_drive(folds):
    """A period falls as the frequency rises: dT/da = -(df/da)/f^2; an elasticity turns its sign."""
    omega, period = (in_own_words(folds.assign_attrs(drive_rate=word)) for word in ("omega", "period"))
    f, names = folds["value"].values[:, None], ("derivative", "derivative_error", "elasticity", "deviation")
    for name, by_omega, by_period in zip(names, (OMEGA, OMEGA, 1.0), (-1.0 / f**2, 1.0 / f**2, -1.0), strict=False):
        np.testing.assert_allclose(omega[name], folds[name] * by_omega, rtol=1e-14)
        np.testing.assert_allclose(period[name], folds[name] * by_period, rtol=1e-14)
    np.testing.assert_allclose(period["deviation"], folds["deviation"] / f[:, 0] ** 2, rtol=1e-13)
    assert "drive_period" in "\n".join(sensitivities_table(period).lines)


@pytest.mark.slow
def test_doubling_with_the_drive(tmp_path):
    """Along the amplitude the drive's frequency is a parameter: 2 = damping + 2 linear + 2 cubic + frequency."""
    given = {"preset": "twin-well", "omega": 1.2, "overrides": {"damping": 0.3}}
    run = swept("duffing", tmp_path / "run", [(1.2, 0.0)], (300, 8), parameters=given, amplitude=[0.25, 0.275])
    run.branches(low=0.24, high=0.29, max_period=2)
    found = run.sensitivities(deviation={"frequency_hz": 1e-3})
    found = with_plain_names(found)
    by = {str(n): found["elasticity"].sel(parameter=n).values for n in found["parameter"].values}
    assert "period_doubling" in [found["kind"].attrs["flag_meanings"].split()[k] for k in found["kind"].values]
    np.testing.assert_allclose(by["cubic"], -0.5, rtol=1e-7)
    total = by["damping"] + 2.0 * (by["linear"] + by["cubic"]) + by["frequency"]
    np.testing.assert_allclose(total, 2.0, rtol=1e-7)
    np.testing.assert_allclose(found["deviation"], 1e-3 * np.abs(found["derivative"].sel(parameter="frequency")))
    text = "\n".join(sensitivities_table(in_own_words(found)).lines)
    assert "omega" in text
    row = next(r for r in sensitivities_table(in_own_words(found)).rows if r["parameter"] == "omega")
    assert row["parameter_value"] == pytest.approx(1.2, rel=1e-12)
    assert row["derivative"] * 1.2 / row["amplitude"] == pytest.approx(row["elasticity"], rel=1e-12)
    assert row["elasticity"] == pytest.approx(by["frequency"][np.argmin(abs(found["value"].values - row["amplitude"]))])


@pytest.mark.slow
def test_pitchfork_of_orbits(tmp_path):
    """Along the amplitude of the symmetric oscillator: the same sums."""
    given = {"preset": "hardening", "omega": 1.0, "overrides": {"damping": 0.1}}
    run = swept("duffing", tmp_path / "run", [(0.0, 0.0)], (300, 4), parameters=given, amplitude=[3.3, 3.4])
    run.branches(low=3.3, high=3.6, max_period=1)
    found = run.sensitivities()
    at = found["kind"].values.tolist().index(found["kind"].attrs["flag_meanings"].split().index("pitchfork"))
    by = {str(n): float(found["elasticity"].sel(parameter=n)[at]) for n in found["parameter"].values}
    assert by["cubic"] == pytest.approx(-0.5, rel=1e-7)
    assert by["damping"] + 2.0 * (by["linear"] + by["cubic"]) + by["frequency"] == pytest.approx(2.0, rel=1e-7)


@pytest.mark.slow
def test_draws_of_the_parameters(computed, tmp_path):
    """Fold of cycles on a section, m = h - 1/(4 g): its deviation with correlated draws; refusals."""
    directory, random = computed(SWEEP), np.random.default_rng(3)
    g = TRUTH["g"] + 0.1 * random.standard_normal(60)
    h = TRUTH["h"] + 0.1 * (g - TRUTH["g"]) + 0.01 * random.standard_normal(60)
    write_draws(tmp_path / "posterior.nc", g, h)
    found = derive(directory, "sensitivities", {"posterior": str(tmp_path)})
    kinds = found["kind"].attrs["flag_meanings"].split()
    fold = found.isel(bifurcation=found["kind"].values.tolist().index(kinds.index("fold")))
    by_g = 1.0 / (4.0 * TRUTH["g"] ** 2)
    np.testing.assert_allclose(fold["derivative"].sel(parameter=["g", "h"]), [by_g, 1.0], rtol=1e-7)
    assert abs(float(fold["derivative"].sel(parameter="w"))) < 1e-8
    row = np.array([by_g, 1.0])
    assert float(fold["deviation"]) == pytest.approx(np.sqrt(row @ np.cov(g, h) @ row), rel=1e-7)
    for given, message in (
        ({"deviation": {"q": 1.0}}, r"unknown parameter 'q'"),
        ({"deviation": {"m": 1.0}}, r"unknown parameter 'm'"),
        ({"deviation": {"g": 0.0}}, r"g=0: must be above 0"),
        ({"posterior": str(tmp_path / "none")}, r"has no posterior.nc"),
        ({"posterior": str(tmp_path), "deviation": {"g": 0.1}}, r"the posterior has its deviation"),
    ):
        with pytest.raises(SpecError, match=message):
            derive(directory, "sensitivities", given)
