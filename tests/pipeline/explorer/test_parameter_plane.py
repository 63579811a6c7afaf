"""Bifurcation curves over the map of two parameters, as the explorer's page gets them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pipeline.explorer import RequestError
from pipeline.explorer.data.arrays import unpack_arrays
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.parameter_plane import curve_orbit, parameter_plane
from pipeline.explorer.data.view import describe_view
from pipeline.layout.own_words import with_plain_names
from pipeline.results.ragged import dense
from pipeline.runs.derive import derive
from pipeline.store.run import RunDirectory
from tests.pipeline.explorer.small_runs import CURVES


@pytest.mark.slow
def test_line__its_own_curves(bent):
    """Of the run that was followed: its curves, and no map."""
    line, _ = bent
    found, curves = parameter_plane(RunDirectory.open(line)), with_plain_names(derive(line, "curves", CURVES))
    assert [axis["name"] for axis in found["axes"]] == ["frequency", "amplitude"]
    assert found["map"] is None
    assert len(found["curves"]) == curves.sizes["curve"] >= 1
    for curve in found["curves"]:
        n = int(curves["n_points"][curve["id"]])
        np.testing.assert_array_equal(curve["x"], curves["first"].values[curve["id"], :n])
        np.testing.assert_array_equal(curve["y"], curves["second"].values[curve["id"], :n])
    assert {point["label"] for point in found["points"]} <= {"CP", "R1", "GPD"}


@pytest.mark.slow
def test_plane__curves_of_another_run(bent):
    """Over the number of attractors, which two folds bound."""
    line, plane = bent
    explored = replace(ExploredRun.open(plane), curves=RunDirectory.open(line))
    found, attractors = parameter_plane(explored), dense(derive(plane, "attractors"))
    assert len(found["curves"]) >= 1
    number = np.array(found["map"]["number"]).reshape(len(found["map"]["y"]), len(found["map"]["x"]))
    expected = (attractors["kind"] > 0).sum("attractor").transpose("amplitude", "frequency").values
    np.testing.assert_array_equal(number, expected)
    assert number.max() < len(found["map"]["colours"])
    assert describe_view(explored, False)["has"]["curves"]
    assert explored.refreshed().curves is explored.curves


@pytest.mark.slow
def test_no_curves(bent):
    """A run without curves says how to get them."""
    _, plane = bent
    found = parameter_plane(RunDirectory.open(plane))
    assert found["curves"] == []
    assert "magpend analyse curves" in found["note"]
    assert not describe_view(ExploredRun.open(plane), False)["has"]["curves"]


@pytest.mark.slow
def test_curve_orbit__by_another_integrator(bent):
    """The orbit closes at the values of its point, with a multiplier 1 on a fold."""
    line, _ = bent
    curves = with_plain_names(derive(line, "curves", CURVES))
    i = int(np.flatnonzero(curves["kind"].values == 0)[0])
    point = int(curves["n_points"][i]) // 4  # not where the curve begins, at the run's own values
    arrays, attrs = unpack_arrays(curve_orbit(RunDirectory.open(line), i, point))
    assert attrs["frequency"] == float(curves["first"][i, point])
    assert attrs["parameters"]["amplitude"] == float(curves["second"][i, point])
    states = arrays["states"].reshape(-1, 2)
    assert states[-1] == pytest.approx(states[0], abs=1e-6)
    assert min(abs(complex(*m) - 1.0) for m in attrs["multipliers"]) < 1e-4
    p, f = attrs["parameters"], attrs["frequency"]

    def rates(t, y):
        drive = p["amplitude"] * np.cos(2.0 * np.pi * f * t)
        return [y[1], drive - p["damping"] * y[1] - p["linear"] * y[0] - p["cubic"] * y[0] ** 3]

    end = solve_ivp(rates, (0.0, attrs["period"] / f), states[0], method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    assert end == pytest.approx(states[0], abs=1e-6)


@pytest.mark.slow
def test_curve_orbit__what_is_not_there(bent):
    line, plane = bent
    with pytest.raises(RequestError, match="curve = 99"):
        curve_orbit(RunDirectory.open(line), 99, 0)
    with pytest.raises(RequestError, match="point = 99999"):
        curve_orbit(RunDirectory.open(line), 0, 99999)
    with pytest.raises(RequestError, match="there are 0 curves"):
        curve_orbit(RunDirectory.open(plane), 0, 0)
