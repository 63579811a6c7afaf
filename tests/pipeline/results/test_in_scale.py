"""Digits of states in tables."""

import pytest

from pipeline.results.tabular import in_scale


@pytest.mark.parametrize(
    ("value", "scale", "text"),
    [
        (0.27, 0.03, "0.27"),
        (1000.27, 0.03, "1000.27"),
        (1000.33, 0.03, "1000.33"),
        (0.123456, 1.0, "0.1235"),
        (12.3456, 1.0, "12.346"),
        (-1.5e-18, 0.03, "0"),
        (1.5e-10, 1e-9, "1.5e-10"),
        (float("nan"), 1.0, "-"),
    ],
)
def test_in_scale(value, scale, text):
    assert in_scale(value, scale) == text
