"""What an axis says of a state."""

from __future__ import annotations

import math

import pytest

from pipeline.plots.labels import _measure


@pytest.mark.parametrize(("unit", "written"), [("rad", "deg"), ("rad/s", "deg/s")])
def test_measure__degrees(unit, written):
    measure = _measure("psi1", r"\psi_1", unit, degrees=True, on_circle=True)
    assert (measure.symbol, measure.unit) == (r"$\psi_1$", written)
    assert math.pi * measure.factor == pytest.approx(180)
