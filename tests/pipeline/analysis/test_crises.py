"""Crises of chaotic sets against closed forms, and against a tangency of manifolds of the tests' own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq, fsolve, minimize_scalar

import magpend
from pipeline.analysis.events.contact import count_bands, fit_lifetimes
from pipeline.analysis.sets import Geometry

LOGISTIC = magpend.model("x' = r*x*(1 - x)", name="logistic", kind="map", r=3.2)
CUBIC = magpend.model("x' = mu*x - x**3", name="cubic", kind="map", mu=0.5)
HENON = magpend.model("x' = 1 - a*x**2 + y\ny' = b*x", name="henon", kind="map", a=0.2, b=0.3)
LINE = Geometry((False,), (1.0,))


def sweep(model, folder, starts, **axis):
    spec = magpend.Spec("sweep", model)
    for name, values in axis.items():
        spec = spec.with_axis(name, values=values)
    spec = spec.with_start_random(n=24, seed=0, **starts).with_integration(n_transient=4000, n_keep=100)
    return magpend.run(spec, folder / "run", workers=0)


def decided(run):
    """The decided events of a run: name, period of the orbit, value and exponent of lifetimes with their errors."""
    table = run.table("events")
    rows = table[~table["what"].isin(["range_end", "not_decided"])]
    names = ["what", "met_period", "value", "value_error", "exponent", "exponent_error"]
    return [tuple(row) for row in rows[names].to_numpy()], table


def window_end():
    """Where the third iterate of the middle of the interval, taken twice, is the unstable orbit of period 3."""

    def thrice(r, x):
        for _ in range(3):
            x = r * x * (1.0 - x)
        return x

    def residual(u):
        return [thrice(*u) - u[1], thrice(u[0], thrice(u[0], 0.5)) - u[1]]

    found, _, flag, message = fsolve(residual, [3.857, 0.555], xtol=1e-14, full_output=True)
    assert flag == 1, message
    return float(found[0])


KNOWN = {
    # two bands merge where the third iterate of 1/2 is the fixed point 1 - 1/r
    "merging": (LOGISTIC, "r", (0.1, 0.9), [3.66, 3.69], "band_merging", 1,
                float(np.roots([1.0, -2.0, -4.0, -8.0])[0].real)),
    "window": (LOGISTIC, "r", (0.1, 0.9), [3.8565, 3.8575], "interior_crisis", 3, window_end()),
    "lost": (LOGISTIC, "r", (0.1, 0.9), [3.98, 4.02], "boundary_crisis", 1, 4.0),
    # the image 2 (mu/3)**1.5 of the critical point is mapped to 0, or onto the orbit +-sqrt(mu + 1)
    "twins": (CUBIC, "mu", (-1.0, 1.0), [2.59, 2.604], "attractor_merging", 1, 1.5 * np.sqrt(3.0)),
    "cubic": (CUBIC, "mu", (-1.0, 1.0), [2.985, 3.01], "boundary_crisis", 2, 3.0),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", KNOWN)
def test_events__crises_of_maps(name, tmp_path):
    model, parameter, box, values, what, period, known = KNOWN[name]
    found, table = decided(sweep(model, tmp_path, {"x": box}, **{parameter: values}))
    assert found, table["sentence"].tolist()
    assert [one[:2] for one in found] == [(what, period)]  # one event, of all sets that meet the orbit
    for _, _, value, error, exponent, exponent_error in found:
        assert abs(value - known) <= error < 1e-6
        # the edge of the density of a map with a quadratic maximum is a square root
        assert abs(exponent - 0.5) <= 3.0 * exponent_error < 0.2
    assert not (table["what"] == "not_decided").any(), table["evidence"].tolist()


def tangency_of_henon():
    """Value of a at which the unstable manifold of the saddle on the basin's boundary first touches its stable one."""

    def saddle(a):
        x = (-0.7 - np.sqrt(0.49 + 4.0 * a)) / (2.0 * a)
        values, vectors = np.linalg.eig([[-2.0 * a * x, 1.0], [0.3, 0.0]])
        k = int(np.abs(values).argmax())
        return np.array([x, 0.3 * x]), vectors[:, k] * np.sign(vectors[0, k]), values[k]

    def is_right(a, x, y):
        """Whether trajectories leave the saddle's neighbourhood towards the set, and not towards infinity."""
        edge = saddle(a)[0][0]
        for _ in range(60):
            if x < edge - 0.4 or x > edge + 0.4:
                break
            x, y = 1.0 - a * x * x + y, 0.3 * x
        return x > edge

    def boundary(a, y):
        low, high = -1.5, -0.8
        for _ in range(48):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if is_right(a, middle, y) else (middle, high)
        return low

    def along(a, t, n):
        start, direction, u = saddle(a)
        x, y = (p + 1e-7 * u**t * d for p, d in zip(start, direction, strict=True))
        for _ in range(n):
            x, y = 1.0 - a * x * x + y, 0.3 * x
        return x, y

    def clearance(a):
        """Least distance from the stable manifold over the leftmost folds of the unstable one.

        The tangency of those of two fewer images is at 1.4269225, of four fewer at 1.426978.
        """
        least = np.inf
        for n in (24, 25):
            t = np.linspace(0.0, 1.0, 6001)
            x, _ = along(a, t, n)
            for k in np.flatnonzero((x[1:-1] < x[:-2]) & (x[1:-1] < x[2:]) & (x[1:-1] < -1.2)) + 1:
                fold = minimize_scalar(
                    lambda s, n=n: along(a, s, n)[0] - boundary(a, along(a, s, n)[1]),
                    bounds=(t[k - 1], t[k + 1]), method="bounded", options={"xatol": 1e-12},
                )  # fmt: skip
                least = min(least, fold.fun)
        return least

    return brentq(clearance, 1.425, 1.428, xtol=1e-8)


@pytest.mark.slow
def test_events__boundary_crisis_of_henon(tmp_path):
    found, table = decided(sweep(HENON, tmp_path, {"x": (-0.1, 0.1), "y": (-0.1, 0.1)}, a=[1.42, 1.43]))
    ((what, period, value, error, exponent, exponent_error),) = found
    assert (what, period) == ("boundary_crisis", 1), table["evidence"].tolist()
    assert abs(value - tangency_of_henon()) <= error < 1e-4
    # ln b2 / ln(b1 b2)**2 at a homoclinic tangency, of the multipliers b1, b2 (Grebogi, Ott and Yorke 1986)
    x = (-0.7 - np.sqrt(0.49 + 4.0 * value)) / (2.0 * value)
    small = np.abs(np.linalg.eigvals([[-2.0 * value * x, 1.0], [0.3, 0.0]])).min()
    assert abs(exponent - np.log(small) / (2.0 * np.log(0.3))) <= 3.0 * exponent_error < 0.3


@pytest.mark.slow
def test_events__no_crisis_at_a_window(tmp_path):
    """Where a stable orbit of period 3 is born in the set, the set meets no orbit beside it."""
    found, table = decided(sweep(LOGISTIC, tmp_path, {"x": (0.1, 0.9)}, r=[3.82, 3.835]))
    crises = ("boundary_crisis", "interior_crisis", "band_merging", "attractor_merging")
    assert not {one[0] for one in found} & set(crises)
    assert "intermittency_i" in set(table["what"])


def orbit(r, n):
    points = np.empty(n)
    points[0] = 0.4
    for k in range(1, n):
        points[k] = r * points[k - 1] * (1.0 - points[k - 1])
    return points[1000:, None]


def test_count_bands__of_the_logistic_map():
    # bands merge at 3.592572 (4 to 2) and 3.678573 (2 to 1); three bands at 3.8565, one beyond 3.8568
    assert [count_bands(orbit(r, 9000), LINE) for r in (3.58, 3.62, 3.7, 3.8565, 3.858, 4.0)] == [4, 2, 1, 3, 1, 1]


def test_fit_lifetimes__a_power_law():
    values = 2.0 + 0.1 * 0.5 ** np.arange(8)
    means = (3.0 * (values - 1.9999) ** -0.7).tolist()
    found = fit_lifetimes(values.tolist(), means, [1000] * 8, 1.9999)
    assert found.exponent == pytest.approx(0.7, abs=1e-6)
    # the value does not depend on the contact
    found = fit_lifetimes(values.tolist(), means, [1000] * 8, 2.0)
    assert found.value == pytest.approx(1.9999, abs=1e-8)
    assert 1e-6 < found.value_error < 1e-3
