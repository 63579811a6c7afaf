"""Crises of chaotic sets against closed forms, and against a tangency of manifolds of the tests' own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve, minimize_scalar

import magpend
from pipeline.analysis.branches.starting_orbits import family_of
from pipeline.analysis.events.contact import (
    Approach,
    Effort,
    SectionMap,
    contact_of,
    count_bands,
    have_come_back,
    passages,
    sample_of,
)
from pipeline.analysis.events.crises import OF_MAP
from pipeline.analysis.events.transients import fit_lifetimes
from pipeline.results.sets import Geometry

LOGISTIC = magpend.model("x' = r*x*(1 - x)", name="logistic", kind="map", r=3.2)
CUBIC = magpend.model("x' = mu*x - x**3", name="cubic", kind="map", mu=0.5)
HENON = magpend.model("x' = 1 - a*x**2 + y\ny' = b*x", name="henon", kind="map", a=0.2, b=0.3)
LINEAR = magpend.model("x' = u*x + y\ny' = 0.3*y", name="linear", kind="map", u=2.0)
UEDA = magpend.model("x'' = B*cos(t) - 0.1*x' - x**3", name="ueda", B=13.3)
LINE = Geometry((False,), (1.0,))


def section_map(model, parameter, value, frequency_hz=None, **fixed):
    """The section map of a model along a parameter."""
    packed = model.load(**{parameter: value}, **fixed).pack()
    family = family_of(model.system, 1, frequency_hz or model.clock.hertz, packed, parameter, 1.0)
    return SectionMap(family, Geometry.of(model), 1e-9)


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
    (error, _) = [column for column in table if column.endswith("_error")]
    names = ["what", "met_period", error.removesuffix("_error"), error, "exponent", "exponent_error"]
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
def test_events__lost_into_a_transient(tmp_path):
    """Beside an independent chaotic state all orbits have two unstable multipliers, so that none is met for sure."""
    model = magpend.model("x' = r*x*(1 - x)\ny' = 3.9*y*(1 - y)", name="two", kind="map", r=3.9)
    found, table = decided(sweep(model, tmp_path, {"x": (0.1, 0.9), "y": (0.1, 0.9)}, r=[3.98, 4.02]))
    ((what, period, value, error, exponent, exponent_error),) = found
    assert (what, period) == ("transient", 0), table["evidence"].tolist()
    assert abs(value - 4.0) <= 3.0 * error < 1e-3
    assert abs(exponent - 0.5) <= 3.0 * exponent_error < 0.35
    assert "no orbit that it meets is proved" in table.loc[table["what"] == "transient", "sentence"].iloc[0]


def tangency_of_ueda():
    """Value of B at which the unstable manifold of the saddle of period 1 touches its stable one, 20 sections later.

    Along the unstable manifold the distance from the stable one has a minimum, which is 0 between these two values.
    """
    force = np.array([13.3884, 13.3889])

    def strobe(state, n, steps=400):
        h, b = 2.0 * np.pi / steps, force.reshape(-1, *[1] * (state.ndim - 2))

        def rate(t, u):
            return np.stack([u[..., 1], b * np.cos(t) - 0.1 * u[..., 1] - u[..., 0] ** 3], axis=-1)

        for k in range(n * steps):
            t = (k % steps) * h
            a = rate(t, state)
            c = rate(t + 0.5 * h, state + 0.5 * h * a)
            d = rate(t + 0.5 * h, state + 0.5 * h * c)
            state = state + h / 6.0 * (a + 2.0 * (c + d) + rate(t + h, state + h * d))
        return state

    saddle = np.array([[0.4044, -5.607]] * 2)
    moves = 1e-5 * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    for _ in range(4):
        ends = strobe(saddle[:, None] + moves, 1)
        matrix = np.stack([ends[:, 1] - ends[:, 2], ends[:, 3] - ends[:, 4]], axis=-1) / 2e-5
        saddle = saddle - np.linalg.solve(matrix - np.eye(2), (ends[:, 0] - saddle)[..., None])[..., 0]
    t, starts, left = 0.6028 + 1e-3 * np.arange(-3, 4), [], []
    for point, m in zip(saddle, matrix, strict=True):
        values, right = np.linalg.eig(m)
        k = int(np.abs(values).argmax())
        v = right[:, k] / -right[1, k]
        w = np.linalg.inv(right)[k] * -right[1, k]
        starts.append(point + 1e-6 * values[k] ** t[:, None] * v)
        left.append(w)
    offset = strobe(np.array(starts), 20) - saddle[:, None]
    lows = []
    for row, w in zip(offset, left, strict=True):
        a, b, c = np.polyfit(t - 0.6028, row @ w, 2)
        lows.append(c - b * b / (4.0 * a))
    return force[0] + (force[1] - force[0]) * lows[0] / (lows[0] - lows[1])


@pytest.mark.slow
def test_contact_of__boundary_crisis_of_ueda():
    """The saddle of period 1 that is met is given here; `analyse events` searches it."""
    along = section_map(UEDA, "B", 13.375, 0.5 / np.pi)
    effort = Effort(64, 192, 3, 12, 1, is_flow=True)
    sample = sample_of(along, 13.375, np.array([3.1, -0.78]), effort)
    saddle = along.saddle(13.375, np.array([0.399, -5.58]), 1)
    approach = Approach(along, sample, 13.375, saddle, effort)
    paths = approach.paths(13.375)
    assert approach.begin(paths[:32], lambda: paths)
    found = contact_of(approach, 13.45)
    assert found is not None
    assert abs(found.value - tangency_of_ueda()) <= found.error < 0.01


def ends(force, states, span):
    """States of oscillators after a time."""

    def rate(t, u):
        x, v = u.reshape(2, -1)
        return np.concatenate([v, force(t, x, v)])

    found = solve_ivp(rate, (0.0, span), np.asarray(states).T.ravel(), method="DOP853", rtol=1e-12, atol=1e-12)
    return found.y[:, -1].reshape(2, -1).T


def away(states, point):
    """Distances from a point but for whole turns, which only the pendulum makes."""
    distance = states - point
    distance[:, 0] -= 2.0 * np.pi * np.round(distance[:, 0] / (2.0 * np.pi))
    return distance


def low_of_fold(force, duration, guess, period, phase, n):
    """Coordinate along a saddle orbit's unstable direction at a fold of its unstable manifold, and its multipliers.

    A point of the unstable manifold at a phase t lies 1e-6 b**t from the orbit, with b its unstable multiplier. Near
    `phase` the manifold has a fold: n sections later the coordinate of the left eigenvector has a minimum there.
    """
    saddle, moves = np.array(guess), 1e-5 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    for _ in range(5):
        there = away(ends(force, saddle + moves, period * duration), saddle)
        matrix = np.stack([there[1] - there[2], there[3] - there[4]], axis=-1) / 2e-5
        saddle = saddle - np.linalg.solve(matrix - np.eye(2), there[0])
    multipliers, right = np.linalg.eig(matrix)
    k = int(np.abs(multipliers).argmax())
    size = np.linalg.norm(right[:, k]) * np.sign(right[0, k])
    for width in (4e-4, 4e-5, 4e-6):
        t = phase + width * np.linspace(-1.0, 1.0, 9)
        starts = saddle + 1e-6 * multipliers[k] ** t[:, None] * right[:, k] / size
        a = away(ends(force, starts, n * duration), saddle) @ np.linalg.inv(right)[k] * size
        phase = t[a.argmin()]
    return a.min(), np.sort(np.abs(multipliers))


def tangency(force, duration, values, *fold):
    """Parameter value at which the unstable manifold of a saddle orbit touches its stable one, and its multipliers."""
    (a, _), (b, multipliers) = (low_of_fold(lambda *u, p=p: force(*u, p), duration, *fold) for p in values)
    return values[0] + (values[1] - values[0]) * a / (a - b), multipliers


MERGING = {
    # x'' + x' - 10 x + 100 x**3 = F cos(3.5 t): Grebogi, Ott, Romeiras and Yorke, Phys. Rev. A 36, 1987, 5365
    "wells": (
        magpend.model("x'' = F*cos(omega*t) - x' + 10*x - 100*x**3", name="wells", F=0.8),
        {"omega": 3.5}, "F", [0.848, 0.8505], {"x": (-0.4, 0.4), "x_dot": (-0.4, 0.4)},
        lambda t, x, v, p: p * np.cos(3.5 * t) - v + 10.0 * x - 100.0 * x**3,
        2.0 * np.pi / 3.5, [0.84925, 0.849256], (0.03872, 0.16509), 3, 0.44132, 30,
    ),
    # th'' + .22 th' + sin th = A cos t: two sets that turn over in opposite directions
    "pendulum": (
        magpend.load_model("driven-pendulum"),
        {"overrides": {"d": 0.22}, "frequency_hz": 0.5 / np.pi},
        "A", [2.645, 2.6475], {"th": (-3.0, 3.0), "w": (-2.0, 2.0)},
        lambda t, x, v, p: p * np.cos(t) - 0.22 * v - np.sin(x),
        2.0 * np.pi, [2.64639, 2.6464], (2.9213, -0.166), 6, 0.70923, 42,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", MERGING)
def test_events__twins_of_a_flow_merge(name, tmp_path):
    """Mirror images meet an orbit between them at the tangency of its manifolds, and stay as long as theory says.

    Trajectories of a chaotic flow differ between machines, and with them whether the pendulum's merging is decided.
    """
    model, fixed, parameter, values, starts, *known = MERGING[name]
    for k in range(4):
        spec = magpend.Spec("sweep", model).with_parameters(**fixed)
        spec = spec.with_axis(parameter, values=[value * (1.0 + k * 1e-12) for value in values])
        spec = spec.with_start_random(n=16, seed=0, **starts).with_integration(n_transient=4000, n_keep=100)
        found, table = decided(magpend.run(spec, tmp_path / str(k), workers=0))
        if found:
            break
    assert len(found) == 1, table["evidence"].tolist()
    ((what, period, value, error, exponent, exponent_error),) = found
    assert (what, period) == ("attractor_merging", known[4])
    contact, (small, large) = tangency(*known)
    assert abs(value - contact) <= error < 1e-3
    # ln b2 / ln(b1 b2)**2 at a homoclinic tangency
    assert abs(exponent - np.log(small) / (2.0 * np.log(small * large))) <= 3.0 * exponent_error < 1.0


def test_have_come_back__after_a_long_stay_elsewhere():
    """Of four trajectories the second comes back after three sections elsewhere, and the third leaves for good."""
    near = np.array([[1, 1, 1, 1, 1, 1], [1, 1, 0, 0, 0, 1], [1, 1, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0]], bool)
    assert have_come_back(near, 3).tolist() == [False, True, False, False]
    assert not have_come_back(near, 4).any()


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


@pytest.mark.parametrize("u", [2.0, -2.0])
def test_passages__of_a_linear_saddle(u):
    """Near 0 of x' = u x + y, y' = .3 y the sum x + y/(u - .3) is multiplied by u, and is 0 on the stable manifold."""
    along = section_map(LINEAR, "u", u)
    saddle = along.saddle(u, np.array([0.01, 0.02]), 1)
    assert saddle.multiplier == pytest.approx(u)
    assert saddle.covectors[0] == pytest.approx([1.0, 1.0 / (u - 0.3)])
    y, distance = np.array([1.0, 1.0, 1.0 / 0.3]), np.array([1e-4, 3e-4, -2e-4])
    starts = np.column_stack([distance - y / (u - 0.3), y])
    found = passages(along.paths(u, starts, 30), saddle, 2, 0.05, along.geometry)
    # y falls below the distance of passages at the third section, of the last trajectory at the fourth; of two bands
    # even and odd sections are two classes
    first = {0: np.array([2, 2, 4]), 1: np.array([3, 3, 3])}
    assert set(found) == {(0, 0), (0, 1)}
    for (_, phase), (clearance, lane, _) in found.items():
        assert lane.tolist() == [0, 1, 2]
        assert clearance == pytest.approx(distance * u ** (first[phase] + 1.0), rel=1e-6)


def test_passages__that_follow_each_other_by_chance():
    """A trajectory that is away in between passes twice: its second clearance is not divided by the growth."""
    along = section_map(LINEAR, "u", 2.0)
    paths = np.ones((1, 12, 2))
    paths[0, 4], paths[0, 6] = (0.01, 0.04), (0.008, 0.0)
    found = passages(paths, along.saddle(2.0, np.zeros(2), 1), 2, 0.05, along.geometry)
    assert found[0, 0][0] == pytest.approx([0.01 + 0.04 / 1.7, 0.008])


def test_sample_of__starts_in_one_band():
    along = section_map(LOGISTIC, "r", 3.8565)
    sample = sample_of(along, 3.8565, np.array([0.5]), OF_MAP)
    assert sample.n_bands == 3
    assert np.ptp(sample.starts) < 0.1 < 0.8 < np.ptp(sample.points)
