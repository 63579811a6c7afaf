"""Measures on cubes of which everything is known, and what decides a claim."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy.stats import binomtest, ttest_1samp

from pipeline.report.estimates import Verdict
from pipeline.report.measures import MEASURES
from pipeline.report.reproduce import judge, spelled
from pipeline.report.study import ClaimTable
from pipeline.specification.problems import SpecError

N = 20
FREQUENCY = np.round(np.arange(2.0, 3.0001, 0.01), 9)


def cube_of(periods, frequency=FREQUENCY, **more):
    """Cells over frequency and walks, of a model without words for motions."""
    periods = np.broadcast_to(np.asarray(periods)[:, None], (len(frequency), N)).copy()
    data = {
        "orbit_period": (("frequency", "branch"), periods),
        "status": (("frequency", "branch"), np.where(periods > 0, 1, 2).astype(np.int8)),
        **more,
    }
    return xr.Dataset(data, {"frequency": frequency}, {"model": "duffing"})


class Known:
    """Results whose cubes are given."""

    def __init__(self, **cubes):
        self.cubes = cubes

    def run(self, name):
        return SimpleNamespace(cube=lambda: self.cubes[name])


def periods_of(frequency):
    """Chaos, a band of period 1 from 2.1 to 2.35 Hz, chaos, period 2 from 2.45 Hz, period 1 from 2.5 Hz."""
    f = frequency + 1e-9
    return np.select([f < 2.1, f < 2.355, f < 2.45, f < 2.5], [0, 1, 0, 2], 1)


@pytest.fixture
def known():
    return Known(run=cube_of(periods_of(FREQUENCY)))


def test_window_width__between_neighbouring_values(known):
    found = MEASURES["window_width"](known, ["run"], {"period": 1, "contains": 2.2})
    assert (found.low, found.high) == (pytest.approx(0.25), pytest.approx(0.27))
    assert (found.n, found.step) == (N, pytest.approx(0.01))


def test_window_width__one_cell_ends_it_and_so_does_the_axis(known):
    found = MEASURES["window_width"](known, ["run"], {"period": 1, "contains": 2.8})
    assert (found.low, found.high) == (pytest.approx(0.5), math.inf)
    assert "end of the axis" in found.text
    assert MEASURES["window_width"](known, ["run"], {"period": 1, "contains": 3.5}).missing
    known.cubes["run"]["orbit_period"][25, 3] = 0
    found = MEASURES["window_width"](known, ["run"], {"period": 1, "contains": 2.2})
    assert (found.low, found.high) == (pytest.approx(0.14), pytest.approx(0.16))
    known.cubes["run"]["orbit_period"][20, 3] = 0
    assert MEASURES["window_width"](known, ["run"], {"period": 1, "contains": 2.2}).high == 0.0


def test_change_of_period__between_neighbouring_values(known):
    options = {"below": 2, "above": 1, "low": 2.3, "high": 2.7}
    known.cubes["run"]["orbit_period"][50, :9] = 2  # fewer than half, beyond the change
    found = MEASURES["change_of_period"](known, ["run"], options)
    assert (found.low, found.high) == (pytest.approx(2.49), pytest.approx(2.5))
    known.cubes["run"]["orbit_period"][50] = 0  # next to a bifurcation motions close slowly
    found = MEASURES["change_of_period"](known, ["run"], options)
    assert (found.low, found.high) == (pytest.approx(2.49), pytest.approx(2.51))
    known.cubes["run"]["orbit_period"][60:64] = 2
    found = MEASURES["change_of_period"](known, ["run"], options)
    assert (found.low, found.high) == (pytest.approx(2.49), pytest.approx(2.64))
    assert "2 such places" in found.text
    assert "nowhere change" in MEASURES["change_of_period"](known, ["run"], options | {"below": 4}).missing
    assert MEASURES["change_of_period"](known, ["run"], options | {"high": 2.3}).missing


def test_last_value_with__one_cell_is_enough(known):
    found = MEASURES["last_value_with"](known, ["run"], {"period": 2})
    assert (found.low, found.high) == (pytest.approx(2.49), pytest.approx(2.5))
    assert found.value == pytest.approx(2.495)
    known.cubes["run"]["orbit_period"][60, 3] = 2
    found = MEASURES["last_value_with"](known, ["run"], {"period": 2})
    assert (found.low, found.high, found.n) == (pytest.approx(2.6), pytest.approx(2.61), N)
    assert MEASURES["last_value_with"](known, ["run"], {"period": 2, "high": 2.55}).high == pytest.approx(2.5)
    assert "none of 20 cells" in MEASURES["last_value_with"](known, ["run"], {"period": 5}).missing
    assert "up to the last value, 3" in MEASURES["last_value_with"](known, ["run"], {"period": 1}).missing


def test_beside_window__counts_both_sides(known):
    options = {"period": 1, "contains": 2.8, "other": [2, 4], "within": 0.02}
    found = MEASURES["beside_window"](known, ["run"], options)
    assert (found.value, found.n) == (1.0, 2 * N)  # 2.48 and 2.49; 3.0 is the end
    found = MEASURES["beside_window"](known, ["run"], options | {"contains": 2.2})
    exact = binomtest(0, 4 * N).proportion_ci(0.95, "exact")
    assert (found.low, found.high) == (pytest.approx(exact.low), pytest.approx(exact.high))


def test_least_share__interval_of_the_least_of_many(known):
    known.cubes["run"]["orbit_period"][70, :6] = 0
    found = MEASURES["least_share"](known, ["run"], {"low": 2.6, "high": 3.0, "period": 1})
    exact = binomtest(14, N).proportion_ci(1 - 0.05 / 41, "exact")
    assert found.value == pytest.approx(0.7)
    assert (found.low, found.high) == (pytest.approx(exact.low), pytest.approx(exact.high))
    assert "2.7" in found.text
    one = MEASURES["least_share"](known, ["run"], {"at": 2.48, "period": 2})
    assert (one.value, one.step) == (1.0, None)
    with pytest.raises(SpecError, match="no labels for motions"):
        MEASURES["least_share"](known, ["run"], {"at": 2.2, "motion": "left"})


@pytest.mark.parametrize("at", [2.203, 2.2])
def test_least_share__only_what_the_axis_has(at):
    coarse = Known(run=cube_of([0, 1, 1], np.array([2.0, 2.25, 2.5])))
    assert MEASURES["least_share"](coarse, ["run"], {"at": at, "period": 1}).missing


def test_agreement__most_cells(known):
    other = cube_of(periods_of(FREQUENCY + 0.05))
    other["orbit_period"][60, :9] = 0  # fewer than half
    known.cubes["other"] = other
    found = MEASURES["agreement"](known, ["run", "other"], {"low": 2.0, "high": 3.0})
    expected = (periods_of(FREQUENCY) == periods_of(FREQUENCY + 0.05)).mean()
    assert found.value == pytest.approx(expected)
    assert MEASURES["agreement"](known, ["run", "run"], {}).value == 1.0


def test_largest_exponent__mean_over_cells_that_are_not_closed(known):
    rng = np.random.default_rng(1)
    exponents = rng.normal(0.3, 0.1, (len(FREQUENCY), N, 1))
    cube = known.cubes["run"].assign(lyapunov=(("frequency", "branch", "exponent"), exponents))
    cube["orbit_period"][40, :5] = 3
    known.cubes["run"] = cube
    found = MEASURES["largest_exponent"](known, ["run"], {"at": 2.4})
    exact = ttest_1samp(exponents[40, 5:, 0], 0.0).confidence_interval(0.95)
    assert (found.low, found.high) == (pytest.approx(exact.low), pytest.approx(exact.high))
    assert MEASURES["largest_exponent"](known, ["run"], {"at": 2.2}).missing


def claim(**given):
    table = {
        "statement": "band",
        "source": "here",
        "measure": "window_width",
        "of": ["run"],
        "unit": "Hz",
        "step": 0.02,
    }
    options = {"period": 1, "contains": 2.2}
    return ClaimTable.model_validate({**table, "options": options, "least": 0.2, "most": 0.3, **given})


@pytest.mark.parametrize(
    ("given", "verdict", "fails"),
    [
        ({}, Verdict.MET, False),
        ({"most": 0.26}, Verdict.UNDECIDED, False),
        ({"most": 0.24, "required": True}, Verdict.NOT_MET, True),
        ({"most": 0.24}, Verdict.NOT_MET, False),
        ({"step": 0.005, "required": True}, Verdict.UNDECIDED, False),
        ({"step": 0.005, "most": 0.24, "required": True}, Verdict.UNDECIDED, False),
        ({"n": N + 1}, Verdict.UNDECIDED, False),
        ({"calibrated": True, "required": True}, Verdict.CALIBRATED, False),
        ({"calibrated": True, "required": True, "most": 0.24}, Verdict.CALIBRATED, True),
        ({"options": {"period": 1, "contains": 3.4}, "required": True}, Verdict.UNDECIDED, False),
    ],
)
def test_judge__what_decides(known, given, verdict, fails):
    found = judge(known, "1", claim(**given))
    assert (found.verdict, found.fails) == (verdict, fails)
    if "contains" in given.get("options", {}):
        assert found.reason.endswith("The claim needs steps of at most 0.02.")
    assert found.reason or verdict in (Verdict.MET, Verdict.NOT_MET)


def test_judge__never_met_by_a_coarse_grid():
    """Three values of which two have period 1 about 2.2 Hz would give a width within the claim."""
    coarse = np.array([1.95, 2.1, 2.2, 2.3, 2.45])
    known = Known(run=cube_of([0, 1, 1, 1, 0], coarse))
    found = judge(known, "1", claim())
    assert found.verdict is Verdict.UNDECIDED
    assert "steps of at most 0.02" in found.reason


def test_spelled__digits_follow_the_interval(known):
    assert spelled(judge(known, "1", claim())).startswith("0.260 Hz (0.250 to 0.270); all of 20 cells from 2.1 to 2.35")
