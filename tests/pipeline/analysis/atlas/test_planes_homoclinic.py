"""Atlas of the Bogdanov-Takens normal form: folds and Hopf points in closed form, homoclinic orbits by shooting."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from pipeline.analysis.atlas.ends import beside_all
from pipeline.analysis.branches.starting_orbits import family_of
from tests.core.flows import model_of, table
from tests.pipeline.analysis.atlas.judge import Rest, judged
from tests.pipeline.analysis.atlas.test_planes_maps import right
from tests.pipeline.analysis.cubes import line, sweep

RATES = {"x": "y", "y": "b1 + b2*x + x^2 - x*y"}
VALUES = {"b1": 0.01, "b2": -0.3}

TAKENS = sweep(
    table("takens", RATES, VALUES, states={"x": {"escape": 10.0}, "y": {"escape": 10.0}}),
    {"kind": "random", "seed": 1, "n": 8, "x": [-0.2, 0.3], "y": [-0.1, 0.1]},
    axes={"b1": line(-0.062, 0.045, 8), "b2": line(-0.62, -0.22, 7)},
    section={"of": "y", "value": 0.0, "direction": "up", "longest": 80.0},
    lengths=(60, 8),
)


def takens(x, p):
    return [x[1], p[0] + p[1] * x[0] + x[0] ** 2 - x[0] * x[1]]


def gap(b1, b2):
    """Distance between the saddle's unstable and stable manifolds where they first come back to y = 0."""
    root = np.sqrt(b2**2 - 4.0 * b1)
    saddle, ends, away = 0.5 * (root - b2), [], 1e-7
    for sign in (1.0, -1.0):
        slope = 0.5 * (sign * np.sqrt(saddle**2 + 4.0 * root) - saddle)
        bend = (1.0 - slope) / (3.0 * slope + saddle)

        def back(_, u):
            return u[1]

        back.terminal = True
        ends.append(
            solve_ivp(
                lambda _, u, sign=sign: sign * np.array(takens(u, (b1, b2))),
                (0.0, 2000.0),
                [saddle - away, -slope * away + bend * away**2],
                "DOP853",
                rtol=1e-12,
                atol=1e-14,
                events=back,
            ).y_events[0][0][0]
        )
    return ends[0] - ends[1]


@pytest.mark.slow
def test_bogdanov_takens(computed):
    """Folds on b1 = b2^2/4, Hopf points on b1 = 0, homoclinic orbits as by shooting, near b1 = -6/25 b2^2."""
    rest = Rest(takens)
    ds, report = judged(computed(TAKENS), lambda kind, *_: rest if kind == "equilibrium" else None)
    right(report)
    assert report.row["not_explained"] == 0
    words = np.array(ds["what"].attrs["flag_meanings"].split())[ds["what"].values]
    b1, b2 = ds["change_b1"].values, ds["change_b2"].values
    assert set(words) == {"fold", "hopf", "homoclinic", "goes_on"}
    np.testing.assert_allclose(b1[words == "fold"], b2[words == "fold"] ** 2 / 4.0, atol=1e-9)
    np.testing.assert_allclose(b1[words == "hopf"], 0.0, atol=1e-9)
    kinds = np.array(ds["kind"].attrs["flag_meanings"].split())[ds["kind"].values]
    for kind, n, first, second in zip(kinds, ds["n_points"].values, ds["b1"].values, ds["b2"].values, strict=True):
        np.testing.assert_allclose(first[:n], second[:n] ** 2 / 4.0 if kind == "fold" else 0.0, atol=1e-10)
    own = np.flatnonzero(words == "homoclinic")
    assert len(own) >= 8
    for first, second in zip(b1[own], b2[own], strict=True):
        by_shooting = brentq(gap, 1.01 * first, 0.99 * first, args=(second,), xtol=1e-12)
        assert first == pytest.approx(by_shooting, abs=2e-8)
        assert first == pytest.approx(-6.0 / 25.0 * second**2, abs=0.03 * abs(second) ** 3)


def test_beside():
    """A stable equilibrium that begins at a Hopf point ends at its fold."""
    model = model_of(RATES, VALUES)
    family = family_of(model.system, 0, 1.0, model.load().pack(), "b1", 0.1)
    (ends,) = beside_all([(family, family.unknowns(np.zeros(2), [0.0]), (-0.05, 0.05))])
    (end,) = ends
    assert end.what == "fold"
    assert end.value == pytest.approx(0.3**2 / 4.0, abs=1e-9)
