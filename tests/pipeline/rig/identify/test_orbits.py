"""Measured orbits as data of a fit, on an oscillator with closed forms (`tests/pipeline/bautin.py`)."""

from __future__ import annotations

import json
import math
import shutil
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import minimize_scalar

from pipeline.layout.vocabulary import parameters_of
from pipeline.rig.identify.build import build
from pipeline.rig.identify.directory import stored_tables
from pipeline.rig.identify.identification import identify
from pipeline.rig.identify.local import fit_local
from pipeline.rig.identify.measured_orbits import read_orbits
from pipeline.rig.identify.objective import evaluate
from pipeline.rig.identify.posterior import bands, draw_posterior, write_posterior
from pipeline.rig.identify.posterior_runs import run_posterior, spread
from pipeline.rig.identify.specification import parse_identification
from pipeline.rig.identify.validation import check_orbits, compare, is_table
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.problems import SpecError
from pipeline.store.errors import RefusedError
from tests.pipeline.bautin import MODEL, SECTION, SWEEP, TRUTH, radius, write_orbits, write_toml

START = {"g": {"start": 1.15, "bounds": [0.5, 3.0]}, "h": {"start": 0.04, "bounds": [-0.5, 0.5]}, "w": {"start": 6.2}}

STABLE, UNSTABLE = (-0.1, -0.05, 0.1), (-0.1, -0.02)


def data_in(folder, sd=0.002):
    """Specification of a fit to stable and unstable cycles, whose tables are written."""
    write_orbits(folder / "stable.csv", STABLE, 1, sd=sd)
    write_orbits(folder / "unstable.csv", UNSTABLE, -1, sd=sd)
    common = {"section": SECTION, "range": [-0.3, 0.3]}
    return {
        "kind": "identification",
        "model": MODEL,
        "identify": {name: dict(one) for name, one in START.items()},
        "orbits": [{"file": "stable.csv", **common}, {"file": "unstable.csv", **common}],
    }


@pytest.fixture
def data(tmp_path):
    return data_in(tmp_path)


def built(data, folder):
    spec = parse_identification(data, folder)
    return build(spec, [], read_orbits(spec))


def expected(theta):
    """Residuals of both tables at values of g, h, w, from the closed form."""
    g, h, w = theta
    rows = []
    for values, sign in ((STABLE, 1), (UNSTABLE, -1)):
        for m in values:
            rows += [(radius(m, sign) - radius(m, sign, g, h)) / 0.002, (TRUTH["w"] - w) / (2 * math.pi) / 0.001]
    return np.array(rows)


@pytest.mark.slow
def test_evaluate__residuals_and_slopes_are_those_of_the_closed_form(data, tmp_path):
    problem = built(data, tmp_path).problem
    theta = np.array([1.1, 0.03, 6.1])
    found = evaluate(problem, theta[None], problem.starts[None], slopes=True)[0]
    np.testing.assert_allclose(found.rows, expected(theta), rtol=1e-7, atol=1e-5)
    for i, h in enumerate((1e-6, 1e-6, 1e-6)):
        step = np.eye(3)[i] * h
        slope = (expected(theta + step) - expected(theta - step)) / (2 * h)
        np.testing.assert_allclose(found.jacobian[:, i], slope, rtol=1e-5, atol=1e-3)


@pytest.mark.slow
def test_bifurcations__are_data(data, tmp_path):
    g, h = TRUTH["g"], TRUTH["h"]
    fold = h - 1.0 / (4.0 * g)
    data["orbits"] = [
        {
            "parameter": "m",
            "section": SECTION,
            "range": [-0.4, 0.3],
            "bifurcations": [
                {"kind": "fold", "interval": [fold - 0.01, fold + 0.01]},
                {"kind": "hopf", "interval": [h - 0.01, h + 0.01]},
            ],
        }
    ]
    del data["identify"]["w"]
    problem = built(data, tmp_path).problem
    theta = np.array([1.1, 0.03])
    found = evaluate(problem, theta[None], problem.starts[None], slopes=True)[0]
    sd = 0.02 / 3.919928
    np.testing.assert_allclose(found.rows * sd, [fold - (0.03 - 1 / 4.4), h - 0.03], atol=1e-7)
    np.testing.assert_allclose(found.jacobian * sd, [[-1 / (4 * 1.1**2), -1.0], [0.0, -1.0]], atol=1e-4)
    np.testing.assert_allclose(fit_local(problem, problem.start).theta, [g, h], atol=1e-6)


@pytest.mark.slow
def test_parameter_sd__compares_the_nearest_orbit_beside_a_fold(data, tmp_path):
    # beyond the fold at these parameters there is no orbit; the nearest one is
    sd, g, h, measured = 0.02, 1.6, 0.05, radius(-0.1, 1)
    data["orbits"] = [{"file": "stable.csv", "section": SECTION, "range": [-0.3, 0.3], "parameter_sd": sd}]
    problem = built(data, tmp_path).problem
    found = evaluate(problem, np.array([[g, h, TRUTH["w"]]]), problem.starts[None], slopes=True)[0]
    assert h - 1 / (4 * g) > -0.12

    def distance(r):
        return ((measured - r) / 0.002) ** 2 + ((-0.1 - (g * r**4 - r**2 + h)) / sd) ** 2

    best = minimize_scalar(distance, bounds=(0.3, 1.2), method="bounded", options={"xatol": 1e-10})
    assert float(found.rows[:3] @ found.rows[:3]) == pytest.approx(best.fun, rel=1e-6)
    up = evaluate(problem, np.array([[g + 1e-4, h, TRUTH["w"]]]), problem.starts[None], slopes=False)[0]
    down = evaluate(problem, np.array([[g - 1e-4, h, TRUTH["w"]]]), problem.starts[None], slopes=False)[0]
    assert found.jacobian[:, 0] @ found.rows == pytest.approx((up.cost - down.cost) / 2e-4, rel=1e-3)


@pytest.mark.slow
def test_parameter_sd__adds_to_the_variance_along_the_branch(data, tmp_path):
    # effective variance: sd_A^2 + (dA/dm sd_m)^2
    sd, g = 0.02, TRUTH["g"]
    data["orbits"] = [{"file": "stable.csv", "section": SECTION, "range": [-0.3, 0.3], "parameter_sd": sd}]
    problem = built(data, tmp_path).problem
    theta = np.array([list(TRUTH.values())])
    found = evaluate(problem, theta, problem.starts[None], slopes=True)[0]
    for i, m in enumerate(STABLE):
        by_g = (radius(m, 1, g + 1e-6) - radius(m, 1, g - 1e-6)) / 2e-6
        by_m = (radius(m + 1e-6, 1) - radius(m - 1e-6, 1)) / 2e-6
        own = found.jacobian[3 * i : 3 * i + 3, 0]
        assert own @ own == pytest.approx(by_g**2 / (0.002**2 + (by_m * sd) ** 2), rel=1e-4)


@pytest.mark.slow
def test_lost__an_orbit_beyond_its_fold_is_counted(data, tmp_path):
    problem = built(data, tmp_path).problem
    found = evaluate(problem, np.array([[2.5, 0.05, 6.0]]), problem.starts[None], slopes=False)[0]
    assert 1 - 4 * 2.5 * 0.15 < 0 < 1 - 4 * 2.5 * 0.07
    assert found.failed == 3
    assert found.cost > 1e11


@pytest.mark.slow
def test_identify__judges_orbits_that_were_held_out(data, tmp_path):
    data["orbits"][1]["hold_out"] = ["no -0.02"]
    data["search"] = {"n_starts": 1, "profiles": False}
    path = write_toml(tmp_path / "fit.toml", data)
    result = identify(path, tmp_path / "out", figures=True, echo=lambda line: None)
    rows = result["orbits"][1]["orbits"]
    assert [row["held_out"] for row in rows] == [False, True]
    assert result["orbits"][1]["rms"]["held_out"]["unstable"]["amplitude"] < 1e-4
    # information of closed-form slopes
    theta = np.array([result["estimates"][name]["value"] for name in "ghw"])
    kept = np.r_[:8]
    slopes = np.array([(expected(theta + s) - expected(theta - s))[kept] / 2e-6 for s in 1e-6 * np.eye(3)])
    np.testing.assert_allclose(result["covariance"]["matrix"], np.linalg.inv(slopes @ slopes.T), rtol=1e-3, atol=1e-12)
    assert (tmp_path / "out/figures/branch-0.png").is_file()
    first = (tmp_path / "out/result.json").read_bytes()
    # resumed from the kept outcome: the same bytes
    (tmp_path / "out/result.json").unlink()
    identify(path, tmp_path / "out", figures=False, echo=lambda line: None)
    again = json.loads((tmp_path / "out/result.json").read_text())
    assert again["estimates"] == json.loads(first)["estimates"]
    assert again["orbits"] == json.loads(first)["orbits"]

    write_orbits(tmp_path / "more.csv", (0.05, 0.15), 1, factor=1.1)
    assert is_table(tmp_path / "more.csv")
    judged = check_orbits(tmp_path / "out", tmp_path / "more.csv")
    assert judged["rms"]["fitted"]["stable"]["amplitude"] == pytest.approx(1 - 1 / 1.1, abs=1e-5)
    table = compare([tmp_path / "out"])
    assert table.rows[0]["orbits_held_out"] < 1e-4


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """An identification with errors of some per cent."""
    folder = tmp_path_factory.mktemp("finished")
    path = write_toml(folder / "fit.toml", {**data_in(folder, 0.02), "search": {"n_starts": 1, "profiles": False}})
    return folder / "out", identify(path, folder / "out", figures=False, echo=lambda line: None)


@pytest.fixture
def fitted(finished, tmp_path):
    """A copy of it."""
    directory, result = finished
    return Path(shutil.copytree(directory, tmp_path / "fitted")), deepcopy(result)


@pytest.mark.slow
def test_posterior__draws_are_those_of_the_covariance(fitted):
    directory, result = fitted
    drawn = draw_posterior(directory, 4000, seed=3)
    values = drawn["value"].sel(parameter=list("ghw")).values
    matrix = np.array(result["covariance"]["matrix"])
    order = [result["names"].index(name) for name in "ghw"]
    np.testing.assert_allclose(np.cov(values.T), matrix[np.ix_(order, order)], rtol=0.15, atol=3e-6)
    assert (drawn["value"].sel(parameter="m").values == result["values"]["m"]).all()
    xr.testing.assert_identical(drawn, draw_posterior(directory, 4000, seed=3))
    assert not drawn.equals(draw_posterior(directory, 4000, seed=4))


@pytest.mark.slow
def test_posterior__bifurcations_and_branches_of_each_draw_are_those_of_the_closed_form(fitted):
    directory, result = fitted
    _, bifurcations, written = write_posterior(directory, 16, seed=2)
    assert all(path.is_file() for path in written)
    drawn = draw_posterior(directory, 16, seed=2)
    g, h = (drawn["value"].sel(parameter=name).values for name in "gh")
    found = bands(stored_tables(directory)[0], result["values"], drawn)
    by_kind = {str(kind): found["bifurcation_value"].values[:, b] for b, kind in enumerate(found["kind"].values)}
    np.testing.assert_allclose(by_kind["fold"], h - 1 / (4 * g), atol=1e-6)
    np.testing.assert_allclose(by_kind["hopf"], h, atol=1e-6)
    low, high = np.quantile(h - 1 / (4 * g), [0.025, 0.975])
    fold = next(row for row in bifurcations.rows if row["kind"] == "fold")
    assert (fold["low"], fold["high"]) == (pytest.approx(low, abs=1e-6), pytest.approx(high, abs=1e-6))
    assert fold["n_draws"] == 16
    for k in range(found.sizes["orbit"]):
        m, is_stable = float(found["parameter_value"][k]), bool(found["is_stable"][k])
        inside = 1 + 4 * g * (m - h)
        there = (inside > 0) & (is_stable | (m < h))
        root = np.sqrt(np.where(there, inside, np.nan))
        expected = np.sqrt((1 + (root if is_stable else -root)) / (2 * g))
        clear = ~there | (np.nan_to_num(root) > 0.05) & ((expected > 0.05) | ~there)
        own = found["amplitude"].values[:, k]
        # close to the fold and the rest an orbit may be lost; where it is found it is the right one
        known = np.isfinite(own)
        np.testing.assert_allclose(own[known], expected[known], atol=1e-5)
        assert (known == there)[clear].all()


@pytest.mark.slow
def test_run_posterior__each_draw_is_a_run_and_its_bifurcations_are_those_of_the_closed_form(fitted, tmp_path):
    directory, result = fitted
    path = write_toml(tmp_path / "sweep.toml", SWEEP)
    folder = run_posterior(path, directory, 2, tmp_path / "study", workers=0, echo=lambda line: None)
    drawn = draw_posterior(directory, 2)
    names = [str(name) for name in drawn["parameter"].values]
    for k in range(2):
        parameters = parameters_of(AnalysedRun.of(folder / f"draw-{k:04d}").cube())
        assert parameters["g"] == drawn["value"].values[k, names.index("g")]
    before = (folder / "draw-0001/run.json").stat().st_mtime_ns
    run_posterior(path, directory, 2, tmp_path / "study", workers=0, echo=lambda line: None)
    assert (folder / "draw-0001/run.json").stat().st_mtime_ns == before
    with pytest.raises(RefusedError, match="different: draws"):
        run_posterior(path, directory, 3, tmp_path / "study", workers=0)
    table = spread(folder, branches=True, attractors=True, echo=lambda line: None)
    rows = {(row["what"], row["name"]): row for row in table.rows}
    values = drawn["value"].values[:, names.index("h")]
    fold, g = rows["value", "fold 1"], drawn["value"].values[:, names.index("g")]
    assert fold["median"] == pytest.approx(np.median(values - 1 / (4 * g)), abs=1e-6)
    hopf = rows["value", "hopf 0"]
    assert hopf["best"] == pytest.approx(result["values"]["h"], abs=1e-6)
    assert hopf["median"] == pytest.approx(np.median(values), abs=1e-6)
    assert hopf["n_draws"] == 2
    assert sum(row["best"] for row in rows.values() if row["what"] == "fraction") == pytest.approx(1.0)
    # at m = 0 half of the cells end on the stable cycle, half at rest
    cycle = next(name for _, name in rows if name.startswith("attractor") and "period 1)" in name).split(" (")[0]
    section = rows["section x", f"{cycle} at m = 0"]
    sizes = [radius(0.0, 1, *v) for v in zip(g, values, strict=True)]
    assert section["median"] == pytest.approx(np.median(sizes), abs=1e-6)
    assert section["best"] == pytest.approx(radius(0.0, 1, result["values"]["g"], result["values"]["h"]), abs=1e-6)
    assert rows["share", f"{cycle} at m = 0"]["low"] == 0.5
    shares = [row["best"] for (what, name), row in rows.items() if what == "share" and "(" in name]
    assert sum(shares) == pytest.approx(1.0)

    write_toml(path, {**SWEEP, "axes": {"g": {"start": 1.0, "stop": 1.1, "num": 2}}})
    with pytest.raises(SpecError, match=r"axes.g: is an identified parameter"):
        run_posterior(path, directory, 3, tmp_path / "other", workers=0)


@pytest.mark.slow
def test_posterior__parameter_that_is_not_determined(fitted):
    directory, result = fitted
    result["covariance"]["matrix"][0][0] = None
    (directory / "result.json").write_text(json.dumps(result))
    with pytest.raises(SpecError, match=r"g: the data do not determine it"):
        draw_posterior(directory, 20)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"hold_out": ["nobody"]}, "hold_out: 'nobody' is no orbit"),
        ({"section": {"of": "z"}}, "'z': is not a state"),
        ({"file": "none.csv"}, "no such file"),
        ({"range": [0.3, -0.3]}, "must rise"),
        ({"parameters": {"q": 1.0}}, "parameters.q"),
        ({"quantities": ["amplitudes"]}, "quantities"),
    ],
)
def test_read_orbits__names_the_problem(data, tmp_path, change, words):
    data["orbits"] = [{**data["orbits"][0], **change}]
    with pytest.raises(SpecError, match=words):
        read_orbits(parse_identification(data, tmp_path))


@pytest.mark.slow
def test_build__an_orbit_that_the_model_does_not_have_at_the_start(data, tmp_path):
    data["identify"]["g"]["start"] = 2.5
    with pytest.raises(SpecError, match=r"'yes -0.1': at the start of the fit the model has no stable orbit"):
        built(data, tmp_path)
