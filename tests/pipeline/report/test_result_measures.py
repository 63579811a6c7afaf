"""Measures of numbers in the results of analyses."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
import xarray as xr
from pydantic import ValidationError
from scipy.stats import norm

from pipeline.products.product import Table
from pipeline.report import measures
from pipeline.report.estimates import Verdict
from pipeline.report.measures import MEASURES
from pipeline.report.reproduce import judge, spelled
from pipeline.report.study import ClaimTable
from pipeline.specification.problems import SpecError

ORBIT = {"kind": "orbit", "rate": math.nan}
ROWS = [
    {"id": 0, **ORBIT, "n_cells": 30, "fraction": 0.3, "low": 0.25, "high": 0.36},
    {"id": 1, **ORBIT, "n_cells": 50, "fraction": 0.5, "low": 0.4, "high": 0.6, "rate": 0.2, "rate_stderr": 0.01},
    {"id": 2, "kind": "rest", "n_cells": 20, "fraction": 0.2, "low": 0.1, "high": 0.3, "rate": 0.1, "bracket": 0.05},
]


class Analysed:
    """Results whose analyses are given, and the options that they were asked with."""

    def __init__(self, ds=None):
        self.ds, self.asked = ds, []

    def run(self, name):
        return SimpleNamespace(derive=self.derive)

    def derive(self, name, **options):
        self.asked.append((name, options))
        return self.ds


@pytest.fixture
def analysed(monkeypatch):
    monkeypatch.setattr(measures, "shown_table", lambda name, ds: Table(ROWS, []))
    return Analysed()


def tabulated(results, **options):
    return MEASURES["tabulated"](results, ["run"], {"analysis": "basins", **options})


def test_tabulated__largest_number_of_the_chosen_rows(analysed):
    found = tabulated(analysed, column="fraction", rank=2, **{"with": {"box": 4}})
    assert (found.value, found.low, found.high, found.n) == (0.3, 0.25, 0.36, 30)
    assert analysed.asked == [("basins", {"box": 4})]
    found = tabulated(analysed, column="fraction", where={"kind": "rest", "id": 2.0})
    assert (found.value, found.low, found.high) == (0.2, 0.1, 0.3)
    assert "kind rest" in found.text
    found = MEASURES["counted_rows"](analysed, ["run"], {"analysis": "basins", "where": {"kind": "orbit"}})
    assert (found.value, found.low, found.high) == (2, 2, 2)


def test_tabulated__interval_from_the_standard_error_or_the_named_bound(analysed):
    half = norm.ppf(0.975) * 0.01
    found = tabulated(analysed, column="rate", rank=1, plus=1.0)
    assert (found.low, found.high) == (pytest.approx(1.2 - half, rel=1e-12), pytest.approx(1.2 + half, rel=1e-12))
    found = tabulated(analysed, column="rate", rank=2, error="bracket")
    assert (found.low, found.high) == (pytest.approx(0.05), pytest.approx(0.15))
    found = tabulated(analysed, column="n_cells", rank=1)
    assert (found.low, found.high) == (50, 50)


def test_tabulated__absent_without_one_row(analysed):
    assert "3 such rows; give rank" in tabulated(analysed, column="fraction").missing
    assert "2 such rows with a number" in tabulated(analysed, column="rate", rank=3).missing  # NaN is no number
    assert "0 such rows" in tabulated(analysed, column="fraction", where={"kind": "torus"}).missing


def test_tabulated__unknown_names(analysed):
    with pytest.raises(SpecError, match="unknown column of basins 'fractoin'; did you mean fraction"):
        tabulated(analysed, column="fractoin", rank=1)
    with pytest.raises(SpecError, match="unknown column of basins 'period'"):
        tabulated(analysed, column="fraction", where={"period": 1})
    with pytest.raises(SpecError, match="unknown analysis 'basin'; did you mean basins"):
        tabulated(analysed, analysis="basin", column="fraction")


def test_derived_number__at_a_parameter_point():
    ds = xr.Dataset(
        {
            "entropy": ("rho", [0.1, 0.2]),
            "entropy_stderr": ("rho", [0.01, 0.02]),
            "exponent": ("rho", [0.5, math.nan]),
            "exponent_low": ("rho", [0.4, math.nan]),
            "exponent_high": ("rho", [0.7, math.nan]),
        },
        {"rho": [20.0, 28.0]},
    )
    results = Analysed(ds)

    def number(**options):
        return MEASURES["derived_number"](results, ["run"], {"analysis": "basins", **options})

    found = number(variable="entropy", at={"rho": 28.0})
    assert (found.value, found.low) == (0.2, pytest.approx(0.2 - norm.ppf(0.975) * 0.02))
    found = number(variable="exponent", at={"rho": 20.0})
    assert (found.value, found.low, found.high) == (0.5, 0.4, 0.7)
    assert "could not compute" in number(variable="exponent", at={"rho": 28.0}).missing
    assert "no values" in number(variable="entropy", at={"rho": 24.0}).missing
    with pytest.raises(SpecError, match="has a value for each rho"):
        number(variable="entropy")
    with pytest.raises(SpecError, match="did you mean entropy"):
        number(variable="entopy")


def test_ratio_of_intervals__of_three_doublings(monkeypatch):
    from pipeline.analysis.branches import analysis

    rows = [{"c": c, "bracket": 1e-6, "type": "period_doubling"} for c in (3.0, 3.449490, 3.544090)]
    monkeypatch.setattr(analysis, "table_of", lambda ds: [*rows, {"c": 3.8, "bracket": 0.0, "type": "fold"}])
    results = Analysed(xr.Dataset(attrs={"parameter": "c"}))
    options = {"type": "period_doubling", "low": 2.0, "high": 4.0, "max_period": 4}
    found = MEASURES["ratio_of_intervals"](results, ["run"], options)
    # the first ratio of the logistic map's cascade, from its doublings 3, 1 + sqrt(6), 3.5440903596
    assert found.value == pytest.approx(4.7515, abs=2e-3)
    assert found.low < (3.449490 - 3.0 + 2e-6) / (3.544090 - 3.449490 + 2e-6) < found.high
    rows.pop()
    assert "three are needed" in MEASURES["ratio_of_intervals"](results, ["run"], options).missing


def claim(**given):
    return ClaimTable.model_validate(
        {"statement": "s", "source": "p", "measure": "tabulated", "of": ("run",), "unit": "x", **given}
    )


@pytest.mark.parametrize(
    ("tolerance", "verdict"), [(0.2, Verdict.MET), (0.05, Verdict.UNDECIDED), (0.0, Verdict.UNDECIDED)]
)
def test_claim__expected_with_tolerance(analysed, tolerance, verdict):
    own = claim(expected=0.5, tolerance=tolerance, options={"analysis": "basins", "column": "fraction", "rank": 1})
    judged = judge(analysed, "f", own)
    assert judged.verdict is verdict
    words = "0.5 ± 0.2 x" if tolerance == 0.2 else "0.5 ± 0.05 x" if tolerance else "Claimed: 0.5 x"
    assert words in spelled(judged)
    assert own.range == (0.5 - tolerance, 0.5 + tolerance)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"expected": 1.0}, "belong together"),
        ({"tolerance": 1.0}, "belong together"),
        ({"expected": 1.0, "tolerance": 0.1, "least": 0.0}, "expected excludes least"),
    ],
)
def test_claim__one_form(given, message):
    with pytest.raises(ValidationError, match=message):
        claim(**given)
