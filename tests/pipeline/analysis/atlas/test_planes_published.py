"""Atlas of CO oxidation against the published points of codimension two of its plane.

Bykov, Yablonskii and Kim, Dokl. Akad. Nauk SSSR 242 (1978) 637; points as MatCont's tutorial prints them.
"""

import numpy as np
import pytest

from tests.core.flows import table
from tests.pipeline.analysis.atlas.judge import Rest, curve_errors, judged
from tests.pipeline.analysis.atlas.test_planes_maps import right
from tests.pipeline.analysis.cubes import line, sweep

pytestmark = pytest.mark.slow

OXIDATION = sweep(
    table(
        "oxidation",
        {"x": "2*q1*z^2 - 2*q5*x^2 - q3*x*y", "y": "q2*z - q6*y - q3*x*y", "s": "q4*z - K*q4*s"},
        {"q1": 2.5, "q2": 1.0, "q3": 10.0, "q4": 0.0675, "q5": 1.0, "q6": 0.1, "K": 0.4},
        define={"z": "1 - x - y - s"},
    ),
    {"kind": "random", "seed": 1, "n": 3, "x": [0.0, 0.3], "y": [0.0, 0.6], "s": [0.0, 0.5]},
    axes={"q2": line(1.0, 1.43, 5), "K": line(0.34, 1.0, 6)},
    section={"of": "x - y", "value": 0.0, "direction": "up", "longest": 1000.0},
    lengths=(15, 6),
)
PUBLISHED = {"bogdanov_takens": [(1.161199, 0.722339), (1.417628, 0.971397)], "cusp": [(1.006408, 0.355991)]}


def rates(x, p):
    """Rates of the three coverages."""
    z = 1.0 - x[0] - x[1] - x[2]
    return [
        5.0 * z**2 - 2.0 * x[0] ** 2 - 10.0 * x[0] * x[1],
        p[0] * z - 0.1 * x[1] - 10.0 * x[0] * x[1],
        0.0675 * (z - p[1] * x[2]),
    ]


def test_oxidation(computed):
    """Published points, every change of equilibria, and the curves of equilibria; no change is left unexplained."""
    rest = Rest(rates)
    ds, report = judged(computed(OXIDATION), lambda kind, *_: rest if kind == "equilibrium" else None)
    right(report)
    assert report.row["not_explained"] == 0
    errors = curve_errors(ds, lambda kind, n: None if n else rest, every=3)
    assert max(errors.values()) < 1e-7
    kinds = np.array(ds["special_kind"].attrs["flag_meanings"].split())[ds["special_kind"].values]
    is_rest = ds["special_period"].values == 0
    for kind, points in PUBLISHED.items():
        found = np.stack([ds[f"special_{name}"].values[is_rest & (kinds == kind)] for name in ("q2", "K")], axis=-1)
        np.testing.assert_allclose(sorted(found.tolist()), points, atol=1e-6)
