"""Runs of flows seen at crossings, from the specification to tables and figures."""

from __future__ import annotations

import numpy as np
import pytest

from magpend_core.status import Status
from pipeline import open_run
from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.analysis.branches.analysis import branches_table
from pipeline.analysis.chaos.analysis import chaos_table
from pipeline.analysis.ragged import dense
from pipeline.layout.vocabulary import model_of, parameters_of
from pipeline.runs.derive import derive
from tests.pipeline.analysis.dense_sets import rows_of
from tests.pipeline.factories import finished

SPEC = """
kind = "sweep"
title = "two attractors of a flow"

[model]
name = "normal_form"  # tests/core/flows.py has it, too: it compiles once
states = { x = {}, y = {} }
parameters = { mu = -0.1, omega = 2.0, cubic = 1.0, quintic = -1.0 }
define = { s = "x**2 + y**2", g = "mu + cubic*s + quintic*s**2" }
equations = { x = "g*x - omega*y", y = "omega*x + g*y" }

[section]
of = "y"
value = 0.3
longest = 20.0

[axes]
mu = { values = [-0.2, -0.1, 0.1] }

[initial_conditions]
kind = "grid"
x = { start = -0.9, stop = 0.9, num = 6 }
y = { start = -1.05, stop = 0.95, num = 6 }

[integration]
rtol = 1e-9
atol = 1e-9
n_transient = 150
n_keep = 12

[products]
lyapunov = { n_transient = 20, n_periods = 64, n_blocks = 4 }
"""


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("flow"), SPEC)


@pytest.mark.slow
def test_run__cube(directory):
    """Returns of the cycle take pi seconds; what rests is left where it rests."""
    ds = open_run(directory)
    assert "frequency" not in ds.coords
    model = model_of(ds)
    assert model.crossing.value == 0.3
    assert parameters_of(ds)["section_value"] == 0.3
    status = ds["status"].values
    assert set(np.unique(status)) == {Status.PERIODIC, Status.NO_RETURN}
    closed = status == Status.PERIODIC
    np.testing.assert_allclose(ds["return_time"].values[closed], np.pi, atol=1e-6)
    np.testing.assert_allclose(ds["section"].sel(state="y").values[closed], 0.3, atol=1e-12)
    assert np.isnan(ds["return_time"].values[~closed]).all()
    assert np.abs(ds["rest_state"].values[~closed]).max() < 0.3
    assert np.isnan(ds["rest_state"].values[closed]).all()
    assert ds["return_time"].attrs["units"] == "s"
    # exponents per second: 0 along the flow, -2 s (2 s - 1) across it, of the cycle's squared radius s
    for mu in (-0.2, -0.1, 0.1):
        s = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * mu))
        own = ds["lyapunov"].sel(mu=mu).values[ds["status"].sel(mu=mu).values == Status.PERIODIC]
        np.testing.assert_allclose(own, np.tile([0.0, 2.0 * s * (1.0 - 2.0 * s)], (len(own), 1)), atol=1e-5)


@pytest.mark.slow
def test_derive__attractors_chaos_and_branches(directory):
    attractors = dense(derive(directory, "attractors"), points=True)
    table = attractors_table(rows_of(attractors))
    rests = [row for row in table.rows if row["kind"] == "equilibrium"]
    cycles = [row for row in table.rows if row["kind"] == "periodic_orbit"]
    assert {row["mu"] for row in rests} == {-0.2, -0.1}
    assert {row["mu"] for row in cycles} == {-0.2, -0.1, 0.1}
    for row in cycles:
        assert row["period_s"] == pytest.approx(np.pi, rel=1e-9)
        assert row["orbit_period"] == 1
    for row in rests:
        assert row["eigenvalue_real"] == pytest.approx(row["mu"], abs=1e-9)
    assert sum(row["n_cells"] for row in table.rows) == attractors["status"].size
    assert "seconds" in table.lines[2]
    chaos = chaos_table(derive(directory, "chaos"))
    assert {row["nature"] for row in chaos.rows} == {"regular"}
    assert {row["exponents_from"] for row in chaos.rows} == {"multipliers", "eigenvalues"}
    assert not any("drive" in line for line in chaos.lines)
    branches = branches_table(derive(directory, "branches", {"low": -0.3, "high": 0.1}))
    # the cycles leave the Hopf point on another section than the run's, and are found on both only once
    assert [row["type"] for row in branches.rows] == ["fold", "hopf"]
    assert [row["mu"] for row in branches.rows] == pytest.approx([-0.25, 0.0], abs=1e-8)
    assert branches.rows[1]["normal_form"] == pytest.approx(1.0, rel=1e-6)
    assert any("equilibrium" in line for line in branches.lines)
