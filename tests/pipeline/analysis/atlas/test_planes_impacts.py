"""Atlas of a driven linear oscillator with a stop, whose orbits between impacts are known in closed form."""

import numpy as np
import pytest
from scipy.optimize import brentq

from pipeline.analysis.atlas.plane import plane_of
from pipeline.analysis.branches.kinds import CURVE_KINDS
from pipeline.runs.derive import AnalysedRun, derive
from tests.core.flows import table
from tests.pipeline.analysis.atlas.judge import Orbits, Way, distance, follow
from tests.pipeline.analysis.cubes import line, sweep

pytestmark = pytest.mark.slow

DAMPING, RESTITUTION = 0.05, 0.7

STRUCK = sweep(
    table("struck", {"x": "v", "v": "A*cos(2*pi*f*t) - 0.1*v - x"}, {"A": 0.05})
    | {"impacts": [{"of": "x - 1", "direction": "up", "set": {"v": "-0.7*v"}}]},
    {"kind": "random", "seed": 1, "n": 3, "x": [-0.9, 0.9], "v": [-1.0, 1.0]},
    axes={"omega": line(0.72, 1.48, 8), "A": line(0.05, 0.65, 8)},
    lengths=(300, 20),
)


def amplitude(p):
    """Amplitude of the orbit that does not touch the stop."""
    w = 2.0 * np.pi * p[..., 0]
    return p[..., 1] / np.hypot(1.0 - w**2, 2.0 * DAMPING * w)


def touches(here, there):
    """Return whether the free orbit reaches the stop on the way from one point to another."""
    return bool((amplitude(np.linspace(here, there, 201)) > 1.0).any())


def moved(s, t, x, v, p):
    """Displacement, speed and acceleration some seconds after the time t, without impacts."""
    w = 2.0 * np.pi * p[0]
    turned = p[1] / (1.0 - w**2 + 2j * DAMPING * w)
    c, d = turned.real, -turned.imag  # x = c cos(w t) + d sin(w t)
    own = np.sqrt(1.0 - DAMPING**2)
    a = x - c * np.cos(w * t) - d * np.sin(w * t)
    b = (v + w * (c * np.sin(w * t) - d * np.cos(w * t)) + DAMPING * a) / own
    decay, cos, sin = np.exp(-DAMPING * s), np.cos(own * s), np.sin(own * s)
    end = t + s
    x = c * np.cos(w * end) + d * np.sin(w * end) + decay * (a * cos + b * sin)
    v = w * (d * np.cos(w * end) - c * np.sin(w * end)) + decay * (
        (own * b - DAMPING * a) * cos - (own * a + DAMPING * b) * sin
    )
    return x, v, p[1] * np.cos(w * end) - 2.0 * DAMPING * v - x


def impact_after(n):
    """Impacts n periods of the drive apart: time and speed of the next one, to first order about such an orbit."""

    def step(u, p):
        x, v, a = moved(n / p[0], u[0], 1.0, -RESTITUTION * u[1], p)
        late = (1.0 - x) / v
        return [u[0] + late, v + a * late]

    return Orbits.of_map(step)


def impacts_of(state, n, p):
    """Times and speeds of the impacts of an orbit in n periods, from the drive's maximum on."""
    (x, v), t, end, found = state, 0.0, n / p[0], []
    while True:
        s = np.linspace(0.0, end - t, 2000)[1:]
        above = np.flatnonzero(moved(s, t, x, v, p)[0] > 1.0)
        if not len(above):
            return found
        k = above[0]
        s = root(0, s[k - 1] if k else 1e-9, s[k], t, x, v, p)
        speed = moved(s, t, x, v, p)[1]
        t, x, v = t + s, 1.0, -RESTITUTION * speed
        found.append((t, speed))


def root(of, low, high, *start):
    """Time between two others at which the displacement (0) is 1 or the speed (1) is 0."""
    return brentq(lambda s: moved(s, *start)[of] - (1.0 - of), low, high, xtol=1e-14)


def peak_of(impact, n, p):
    """Highest displacement between an impact and the next one, n periods later."""
    s, start = np.linspace(0.0, n / p[0], 4001)[1:-1], (impact[0], 1.0, -RESTITUTION * impact[1], p)
    speed = moved(s, *start)[1]
    tops = np.flatnonzero((speed[:-1] > 0.0) & (speed[1:] <= 0.0))
    return max(moved(root(1, s[k], s[k + 1], *start), *start)[0] for k in tops)


def test_grazing(computed):
    """The free orbit ends where its amplitude is 1, and only there; orbits with one impact where their peak is 1."""
    run = AnalysedRun.of(computed(STRUCK))
    ds = derive(run, "atlas", {"windows": 0})
    names = ds.attrs["first_parameter"], ds.attrs["second_parameter"]
    plane = plane_of(derive(run, "attractors"), names)
    words = np.array(ds["what"].attrs["flag_meanings"].split())[ds["what"].values]
    here, there, place = (
        np.stack([ds[f"{role}_{name}"].values for name in names], axis=-1) for role in ("here", "there", "change")
    )
    row_of = {
        (*plane.values[node], own): row
        for row, (node, own) in enumerate(zip(plane.node, plane.attractor.tolist(), strict=True))
    }
    rows = [row_of[*p, own] for p, own in zip(here, ds["change_attractor"].values.tolist(), strict=True)]
    states, periods = np.array([plane.points[row][0] for row in rows]), plane.period[rows]
    # the free orbit: x = 1 is not reached
    is_free = np.array([n == 1 and not impacts_of(u, 1, p) for u, n, p in zip(states, periods, here, strict=True)])
    ends = is_free & [touches(*one) for one in zip(here, there, strict=True)]
    has_free = {
        int(node)
        for node, n, u in zip(plane.node, plane.period, plane.points, strict=True)
        if n == 1 and amplitude(plane.values[node]) < 1.0 and not impacts_of(u[0], 1, plane.values[node])
    }
    pairs = [(a, b) for e in plane.edges for a, b in (e, e[::-1])]
    crossing = [a in has_free and touches(plane.values[a], plane.values[b]) for a, b in pairs]
    assert ends.sum() == sum(crossing) > 10
    assert (words[ends] == "grazing").all()
    np.testing.assert_allclose(amplitude(place[ends]), 1.0, atol=1e-8)
    assert set(words[is_free & ~ends]) <= {"goes_on", "lives_on"}
    assert set(words[np.abs(amplitude(place) - 1.0) < 1e-6]) == {"grazing"}
    # orbits with one impact: their peak touches the stop
    struck = []
    for k in np.flatnonzero((words == "grazing") & ~is_free):
        n = int(periods[k])
        (impact,) = impacts_of(states[k], n, here[k])
        way = Way(impact_after(n), np.array(impact), here[k], place[k], is_stable=False)
        follow([way])
        struck.append(peak_of(way.fate.state, n, place[k]))
    assert len(struck) >= 8
    np.testing.assert_allclose(struck, 1.0, atol=1e-8)


def test_curves_of_struck_orbits(computed):
    """Folds and doublings of orbits with one impact lie where the closed form has them."""
    ds = derive(AnalysedRun.of(computed(STRUCK)), "atlas", {"windows": 0})
    names = ds.attrs["first_parameter"], ds.attrs["second_parameter"]
    span = [np.ptp(ds[f"here_{name}"].values) for name in names]
    judged = set()
    for number in range(ds.sizes["curve"]):
        n, m = int(ds["orbit_period"][number]), int(ds["n_points"][number])
        kind = CURVE_KINDS[int(ds["kind"][number])]
        p = np.stack([ds[name].values[number, :m] for name in names], axis=-1)
        found = [impacts_of(u, n, q) for u, q in zip(ds["section"].values[number, :m], p, strict=True)]
        if m and all(len(one) == 1 for one in found):
            impacts = np.array([one[0] for one in found])
            assert distance(impact_after(n), kind, impacts, p, np.array(span)) < 1e-7
            judged.add((kind, n))
    assert judged >= {("fold", 1), ("fold", 2), ("period_doubling", 1), ("period_doubling", 2)}
