from __future__ import annotations

import json

import numpy as np

from pipeline.layout.writing import json_value


def test_json_value__is_what_json_can_hold():
    given = {
        "whole": np.int64(3),
        "text": "a",
        "flag": np.bool_(True),
        "not finite": [np.nan, -np.inf, np.float64(0.1)],
        "matrix": np.array([[1.0, np.inf], [2.0, 3.0]]),
        "inner": {"pair": (1.5, float("nan")), "none": None},
    }
    expected = {
        "whole": 3,
        "text": "a",
        "flag": True,
        "not finite": [None, None, 0.1],
        "matrix": [[1.0, None], [2.0, 3.0]],
        "inner": {"pair": [1.5, None], "none": None},
    }
    found = json_value(given)
    assert found == expected
    assert json.loads(json.dumps(found, allow_nan=False)) == expected
