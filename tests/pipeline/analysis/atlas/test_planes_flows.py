"""Atlases of driven oscillators and of flows whose plane is known."""

import numpy as np
import pytest

from tests.core.flows import table
from tests.pipeline.analysis.atlas.judge import Orbits, Rest, curve_errors, judged, of_rates, periods_of
from tests.pipeline.analysis.atlas.test_planes_maps import right
from tests.pipeline.analysis.cubes import line, sweep

pytestmark = pytest.mark.slow


def starts(n, **ranges):
    """Return random starts."""
    return {"kind": "random", "n": n, "seed": 1, **ranges}


DUFFING = sweep(
    table("hardening", {"x": "v", "v": "A*cos(2*pi*f*t) - d*v - x - x^3"}, {"d": 0.1, "A": 0.05}),
    starts(10, x=[-1.5, 1.5], v=[-1.5, 1.5]),
    axes={"omega": line(0.9, 1.4, 18), "A": line(0.02, 0.12, 14)},
    lengths=(200, 8),
    tolerance=1e-8,
    closes=1e-4,
)
MEISSNER = sweep(
    table("meissner", {"x": "v", "v": "-0.1*v - (s + e*square(t*f, 0.5))*x - x^3"}, {"s": 1.0, "e": 0.3}),
    starts(8, x=[-1.5, 1.5], v=[-1.5, 1.5]),
    axes={"s": line(0.3, 1.7, 15), "e": line(0.03, 0.83, 13)},
    frequency_hz=1.0 / np.pi,
    lengths=(200, 8),
    tolerance=1e-8,
    closes=1e-5,
)
BAUTIN = sweep(
    table(
        "bautin",
        {"x": "g*x - w*y", "y": "w*x + g*y"},
        {"a": -0.1, "b": 0.4, "w": 2.0},
        define={"s": "x^2 + y^2", "g": "a + b*s - s^2"},
    ),
    starts(8, x=[-1.2, 1.2], y=[-1.2, 1.2]),
    axes={"b": line(-0.63, 1.0, 15), "a": line(-0.22, 0.13, 15)},
    section={"of": "y", "value": 0.0, "direction": "up", "longest": 20.0},
    lengths=(60, 8),
)


def points_of(ds, number):
    """Return the parameters of a curve's points."""
    n = int(ds["n_points"][number])
    names = ds.attrs["first_parameter"], ds.attrs["second_parameter"]
    return np.stack([ds[name].values[number, :n] for name in names], axis=-1)


def curves_of(ds, kind, period):
    """Return the parameters of the curves of a kind and a period."""
    words = np.array(ds["kind"].attrs["flag_meanings"].split())[ds["kind"].values]
    own = np.flatnonzero((words == kind) & (ds["orbit_period"].values == period))
    return [points_of(ds, number) for number in own]


def hardening(t, x, p):
    return [x[1], p[1] * np.cos(2.0 * np.pi * p[0] * t) - 0.1 * x[1] - x[0] - x[0] ** 3]


def test_duffing(computed):
    """Two folds that meet in the cusp at omega = 1.0901095, A = .0513635."""
    orbits = periods_of(hardening, lambda p: 1.0 / p[0], 32)
    ds, report = judged(computed(DUFFING), lambda kind, n, *_: orbits.period(n))
    right(report)
    assert report.row["orbits_not_explained"] == 0
    assert max(curve_errors(ds, lambda kind, n: orbits.period(n), every=3).values()) < 1e-7
    names = np.array(ds["special_kind"].attrs["flag_meanings"].split())[ds["special_kind"].values]
    (k,) = np.flatnonzero(names == "cusp")
    first, second = (ds[name].values[k] for name in ("special_frequency", "special_A"))
    assert 2.0 * np.pi * first == pytest.approx(1.0901095, abs=2e-7)
    assert second == pytest.approx(0.0513635, abs=2e-7)


def meissner(x, p):
    """State after a period: two halves with constant stiffness."""
    x = np.stack(np.broadcast_arrays(*x)).astype(complex)
    for sign in (1.0, -1.0):

        def rates(_, u, q, sign=sign):
            return [u[1], -0.1 * u[1] - (q[0] + sign * q[1]) * u[0] - u[0] ** 3]

        x = of_rates(rates, 0.0, np.pi / 2.0, x, p, 16)
    return x


def trace(s, e, damping=0.1, half=np.pi / 2.0):
    """Trace of the monodromy matrix of the origin, in closed form."""
    total = np.eye(2)
    for stiffness in (s + e, s - e):
        rate = np.emath.sqrt(stiffness - damping**2 / 4.0)
        c, d = np.cos(rate * half), np.sin(rate * half) / rate
        one = np.array([[c + damping / 2.0 * d, d], [-stiffness * d, c - damping / 2.0 * d]])
        total = np.exp(-damping * half / 2.0) * one @ total
    return float(np.trace(total).real)


def test_meissner(computed):
    """Principal tongue: the doubling of the origin where tr M = -1 - det M."""
    orbits = Orbits.of_map(meissner)
    ds, report = judged(computed(MEISSNER), lambda kind, n, *_: orbits.period(n))
    right(report)
    doublings = [p for p in curves_of(ds, "period_doubling", 1) if len(p)]
    assert doublings
    for s, e in np.concatenate(doublings):
        assert trace(s, e) == pytest.approx(-1.0 - np.exp(-0.1 * np.pi), abs=1e-7)


def radial(x, p):
    return p[1] + p[0] * (x[0] ** 2 + x[1] ** 2) - (x[0] ** 2 + x[1] ** 2) ** 2


class Cycles(Rest):
    """Cycles of the generalised Hopf bifurcation, by their squared radius s: a + b s - s^2 = 0."""

    def __init__(self):
        super().__init__(lambda s, p: [p[1] + p[0] * s[0] - s[0] ** 2])

    def start(self, state):
        return np.array([np.sum(state**2)])

    def away(self, points, state):
        return float(np.abs((points**2).sum(axis=1) - state[0]).min())

    def critical(self, slopes, x):
        return {"fold": -slopes[:, 0, 0], "hopf": x[:, 0]}

    smooth = critical


def test_generalised_hopf(computed):
    """Hopf points on a = 0, folds of cycles on b^2 = -4 a with b > 0; areas of the three regions."""
    rest = Rest(lambda x, p: [radial(x, p) * x[0] - 2.0 * x[1], 2.0 * x[0] + radial(x, p) * x[1]])
    cycles = Cycles()
    ds, report = judged(computed(BAUTIN), lambda kind, *_: rest if kind == "equilibrium" else cycles)
    right(report)
    for b, a in np.concatenate(curves_of(ds, "hopf", 0)):
        assert abs(a) < 1e-9, b
    for b, a in np.concatenate(curves_of(ds, "fold", 1)):
        assert a == pytest.approx(-(b**2) / 4.0, abs=1e-8)
