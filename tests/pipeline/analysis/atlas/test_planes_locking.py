"""Atlas of the forced Van der Pol oscillator near 1:1: folds, Neimark-Sacker curves, and the points R1 between them."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.core.flows import table
from tests.pipeline.analysis.atlas.judge import curve_errors, judged, periods_of
from tests.pipeline.analysis.atlas.test_planes_maps import right
from tests.pipeline.analysis.cubes import line, sweep

pytestmark = pytest.mark.slow

FORCED = sweep(
    table("forced", {"x": "v", "v": "0.4*(1 - x^2)*v - x + A*cos(2*pi*f*t)"}, {"A": 0.3}),
    {"kind": "random", "n": 3, "seed": 1, "x": [-2.0, 2.0], "v": [-2.0, 2.0]},
    axes={"omega": line(0.82, 1.22, 9), "A": line(0.05, 0.85, 8)},
    lengths=(200, 20),
    tolerance=1e-8,
)
SPAN = np.array([0.4 / (2.0 * np.pi), 0.8])


def rates(t, x, p):
    return [x[1], 0.4 * (1.0 - x[0] ** 2) * x[1] - x[0] + p[1] * np.cos(2.0 * np.pi * p[0] * t)]


def conditions(z):
    """Return what vanishes for an orbit, at a fold and at a Neimark-Sacker point, by variational equations."""
    p = z[2:] * SPAN

    def varied(t, u):
        slope = np.array([[0.0, 1.0], [-0.8 * u[0] * u[1] - 1.0, 0.4 * (1.0 - u[0] ** 2)]])
        return [*rates(t, u, p), *(slope @ u[2:].reshape(2, 2)).ravel()]

    start = [*z[:2], 1.0, 0.0, 0.0, 1.0]
    end = solve_ivp(varied, (0.0, 1.0 / p[0]), start, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    monodromy = end[2:].reshape(2, 2)
    shared = end[:2] - z[:2]
    return shared, {"fold": np.linalg.det(monodromy - np.eye(2)), "neimark_sacker": np.linalg.det(monodromy) - 1.0}


def nearest(kind, z):
    """Return the unknowns of the nearest bifurcation, parameters in units of the plane, by Newton's method."""

    def at(z):
        closes, critical = conditions(z)
        return np.append(closes, critical[kind])

    h = 1e-5
    for _ in range(4):
        slopes = np.stack([(at(z + h * one) - at(z - h * one)) / (2.0 * h) for one in np.eye(4)], axis=-1)
        step = np.linalg.lstsq(slopes, -at(z))[0]
        z = z + step
        if np.abs(step).max() < 1e-9:
            return z
    raise AssertionError(f"no {kind} near {z}: last step {step}")


def test_forced_van_der_pol(computed):
    """Every change of orbits, and points of the curves by scipy; a Neimark-Sacker curve ends at each of both R1."""
    orbits = periods_of(rates, lambda p: 1.0 / p[0], 32)
    ds, report = judged(computed(FORCED), lambda kind, n, *_: orbits.period(n) if n else None)
    right(report)
    assert report.row["orbits_not_explained"] == 0
    errors = curve_errors(ds, lambda kind, n: orbits.period(n), every=3)
    assert max(errors.values()) < 1e-7
    kinds = np.array(ds["kind"].attrs["flag_meanings"].split())[ds["kind"].values]
    specials = np.array(ds["special_kind"].attrs["flag_meanings"].split())[ds["special_kind"].values]
    r1 = np.stack([ds[f"special_{name}"].values[specials == "r1"] for name in ("frequency", "A")], axis=-1)
    assert len(r1) == 2
    assert sorted(kinds[list(errors)]) == ["fold", "neimark_sacker", "neimark_sacker"]
    for number in errors:
        n = int(ds["n_points"][number])
        p = np.stack([ds[name].values[number, :n] for name in ("frequency", "A")], axis=-1)
        z = np.append(ds["section"].values[number, :n], p / SPAN, axis=1)
        for k in range(n // 8, n, n // 4):
            found = nearest(kinds[number], z[k])
            np.testing.assert_allclose(found[2:], z[k, 2:], atol=1e-6)
        if kinds[number] == "neimark_sacker":
            assert min(np.abs(p[end] - one).max() for end in (0, -1) for one in r1) < 1e-6
    for one, x in zip(r1, ds["special_section"].values[specials == "r1"], strict=True):
        closes, critical = conditions(np.append(x, one / SPAN))
        np.testing.assert_allclose([*closes, *critical.values()], 0.0, atol=1e-6)
