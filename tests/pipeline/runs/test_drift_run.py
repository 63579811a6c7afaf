"""Runs whose parameters move: from the specification to tipping points, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from magpend_core.status import Status
from pipeline import open_run
from pipeline.analysis.tipping.analysis import tipping_table
from pipeline.analysis.tipping.delay import delay_table, lags, left_at
from pipeline.layout.plan import make_plan
from pipeline.layout.vocabulary import model_of, parameters_of
from pipeline.runs.derive import derive
from pipeline.runs.drawing import figure
from pipeline.specification.models import KEPT
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from tests.pipeline.factories import FOLD, FOLD_LENGTH, quietly

LENGTH, SPEC = FOLD_LENGTH, FOLD


def with_changes(**tables):
    return {**SPEC, **tables}


@pytest.fixture(scope="module")
def moving_fold(tmp_path_factory):
    out = tmp_path_factory.mktemp("drift") / "fold"
    quietly(SPEC, out)
    return out


def passing_time(y, rate):
    """Time in which y' = y**2 - 1 + rate leads from y to 1."""
    d = rate - 1.0
    if d > 0:
        r = np.sqrt(d)
        return (np.arctan(1.0 / r) - np.arctan(y / r)) / r
    r = np.sqrt(-d)
    return (np.log((1.0 - r) / (1.0 + r)) - np.log((y - r) / (y + r))) / (2.0 * r)


def critical_rate(y):
    """Rate at which x + l has just come to 1, the unstable state at rest, when the ramp ends."""
    low = 1.0 + 1e-9 if y < 0 else 1.0 - (1.0 - 1e-9) * y**2
    return brentq(lambda rate: passing_time(y, rate) - LENGTH / rate, low, 3.0, xtol=1e-14)


@pytest.mark.slow
def test_run__stores_the_parameter_at_its_sections(moving_fold):
    ds = open_run(moving_fold)
    seconds = np.arange(1, 41)
    assert ds["l_at_section"].dims == ("l_rate_per_s", "period_index")
    for rate, row in zip(ds["l_rate_per_s"].values, ds["l_at_section"].values, strict=True):
        np.testing.assert_allclose(row, np.minimum(rate * seconds, LENGTH), rtol=1e-14)
    assert parameters_of(ds)["l_to"] == LENGTH
    assert model_of(ds).parameter("l_rate_per_s").unit == "1/s"
    # a start at the stable state follows it at rate r < 1 as x + l = -sqrt(1 - r) does
    y = (ds["section"].isel(state=0) + ds["l_at_section"]).transpose("initial_condition", "l_rate_per_s", ...).values
    np.testing.assert_allclose(y[0, 0, 19], -np.sqrt(0.1), atol=2e-2)
    assert ds["status"].values[-1].tolist() == [Status.DIVERGED, Status.DIVERGED]
    assert ds["status"].values[0].tolist() == [Status.PERIODIC, Status.PERIODIC]


@pytest.mark.slow
def test_tipping__critical_rates_are_those_of_the_closed_form(moving_fold):
    ds = derive(moving_fold, "tipping", {"settle": 60, "keep": 32})
    assert ds["critical_start"].values.tolist() == [0, 1]
    expected = [critical_rate(-1.0), critical_rate(0.25)]
    assert abs(expected[0] - expected[1]) > 1e-3
    for value, low, high, wanted in zip(
        ds["critical_value"].values, ds["critical_low"].values, ds["critical_high"].values, expected, strict=True
    ):
        assert high - low <= 1e-6 * 0.4
        assert low - 1e-8 <= wanted <= high + 1e-8
        assert value == pytest.approx(wanted, abs=4e-7)
    assert ds["critical_from"].values.tolist() == [0, 0]
    assert ds["critical_to"].values.tolist() == [-2, -2]
    assert str(ds["attractor_kind"].values[0]) == "equilibrium"
    np.testing.assert_allclose(ds["attractor_point"].values, [[-1.0 - LENGTH]], atol=1e-8)
    table = tipping_table(ds)
    assert [row["to"] for row in table.rows] == ["diverged", "diverged"]
    assert any("both ends decided" in line for line in table.lines)


def test_delay__of_a_synthetic_passage():
    """An orbit of period 1 that begins to alternate at section 30, after a start off the orbit."""
    n = np.arange(60)
    x = 0.01 * n + 0.5 * (n < 3) * (-1.0) ** n + 1e-3 * (-1.0) ** n * 1.5 ** np.maximum(n - 30, 0) * (n > 30)
    model = Spec.parse(SPEC).model
    lag = lags(x[None, :, None], 1, model)
    step = np.abs(np.diff(x))
    np.testing.assert_allclose(lag[0, 1:], step)
    (at,) = left_at(lag, 0.05)
    assert at == 4 + int(np.argmax(step[3:] > 0.05))
    assert left_at(lag, 1e-4)[0] == -1  # never near


@pytest.mark.slow
def test_delay__and_figure_of_a_run(moving_fold):
    ds = derive(moving_fold, "delay", {"distance": 1.2, "static": 0.0})
    assert ds["left"].shape == (4, 2)
    assert delay_table(ds).rows[0]["n_cells"] == 2
    drawn = figure(moving_fold, "drift")
    np.testing.assert_allclose(np.nanmax(drawn.data["l_at_section"]), LENGTH)


def test_derive__refuses_analyses_that_take_parameters_as_constant(moving_fold):
    for name in ("attractors", "branches", "basins", "chaos"):
        with pytest.raises(SpecError, match=r"its parameter l moves .*needs a run with constant parameters"):
            derive(moving_fold, name)


def test_spec__comes_back_and_is_the_identity():
    spec = Spec.parse(SPEC)
    assert Spec.parse(spec.as_dict(), KEPT).as_dict() == spec.as_dict()
    plan = make_plan(spec)
    one = plan.identity
    other = make_plan(Spec.parse(with_changes(drift={"l": {"to": 21.0}}))).identity
    assert one["spec"]["drift"] == {"l": {"to": LENGTH, "shape": "linear"}}
    assert one["spec"]["drift"] != other["spec"]["drift"]
    plain = Spec.parse({k: v for k, v in SPEC.items() if k not in ("drift", "axes")})
    without = make_plan(plain).identity
    assert "drift" not in without["spec"]


# bounds hold at both ends of a ramp: a mass is above 0; the drive switches at instants that its duty cycle sets
PENDULUM = {"model": None, "axes": None, "initial_conditions": {"kind": "random", "n": 2}}
PROBLEMS = [
    ({"drift": {"frequency_hz": {"to": 1.0, "duration_s": 2.0}}}, "drift.frequency_hz: the drive's frequency"),
    ({"drift": {"l": {}}}, "drift.l: give two of to, a rate"),
    ({"drift": {"l": {"to": -1.0}}}, "drift.l: from 0 to -1 the ramp would take"),
    ({"drift": {"l": {"to": 1.0, "rate_per_period": 1.0}}}, "rate_per_s and rate_per_period are both given"),
    ({"drift": {"l": {"to": 1.0, "rate_per_s": 1.0}}}, "axes.l_rate_per_s: is also drift.l.rate_per_s"),
    ({"drift": {"l": {"to": 1.0, "start_s": -1.0}}}, "drift.l.start_s = -1.0: must be at least 0"),
    ({"drift": {"l": {"to": 1.0, "hold_s": -1.0}}}, "drift.l.hold_s = -1.0: must be at least 0"),
    ({"drift": {"l": {"to": 1.0, "hold_s": 1.0, "hold_periods": 1.0}}}, "hold_s and hold_periods are both given"),
    ({"drift": {"l": {"to": 1.0}}, "axes": {**FOLD["axes"], "l_hold_s": {"values": [-1.0]}}}, "-1 s after the ramp"),
    ({"drift": {"l": {"file": "no.csv"}}}, "drift.l.file = 'no.csv': cannot be read"),
    ({"kind": "continuation", "continuation": {"path": "l_rate_per_s"}}, "drift: a continuation starts"),
    ({"section": {"of": "x"}, "parameters": {}}, "section: parameters move in time"),
    ({"integration": {"stop_when_closed": True}}, "integration.stop_when_closed: an orbit cannot close"),
    ({"products": {"lyapunov": {}}}, "products.lyapunov: is measured on an attractor"),
    ({"drift": {"m1": {"to": -1.0, "duration_s": 1.0}}, **PENDULUM}, "drift.m1: m1 = -1.0 is out of bounds"),
    ({"drift": {"duty_cycle": {"to": 0.4, "duration_s": 1.0}}, **PENDULUM}, "drift.duty_cycle: "),
]


def test_spec__says_what_is_wrong():
    for changes, problem in PROBLEMS:
        with pytest.raises(SpecError) as error:
            Spec.parse({key: value for key, value in with_changes(**changes).items() if value is not None})
        assert any(problem in p for p in error.value.problems), error.value.problems


def test_spec__reads_a_file(tmp_path):
    (tmp_path / "l.csv").write_text("time_s,value\n# a comment\n5,0\n6,1\n9,0.5\n", "utf-8")
    data = {k: v for k, v in SPEC.items() if k != "axes"}
    spec = Spec.parse({**data, "drift": {"l": {"file": "l.csv", "start_s": 2.0}}}, tmp_path)
    (ramp,) = spec.ramps
    assert (ramp.times_s, ramp.values) == ((0.0, 1.0, 4.0), (0.0, 1.0, 0.5))
    assert Spec.parse(spec.as_dict(), KEPT).ramps == spec.ramps
    for text, problem in (
        ("t,v\n", "must begin with"),
        ("time_s,value\n1,2\n1,3\n", "time must rise"),
        ("time_s,value\n1,x\n2,3\n", "two numbers"),
    ):
        (tmp_path / "l.csv").write_text(text, "utf-8")
        with pytest.raises(SpecError, match=problem):
            Spec.parse({**data, "drift": {"l": {"file": "l.csv"}}}, tmp_path)
