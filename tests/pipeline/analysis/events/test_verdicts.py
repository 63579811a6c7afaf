"""Verdicts on the ends of chaotic sets and tori, on located bifurcations made by hand and on rules in place of maps."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from pipeline.analysis.branches.kinds import DOUBLING, KINDS, TORUS
from pipeline.analysis.events import breakups
from pipeline.analysis.events.breakups import LOCKED, _Found, breakup_of
from pipeline.analysis.events.cascades import DELTA, _chain, cascade_of, torus_of
from pipeline.analysis.events.kinds import BREAKUP, CASCADE
from pipeline.analysis.events.lines import Fate
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import BOUNDED_SET, CHAOTIC_SET
from pipeline.layout.vocabulary import TORUS as TORUS_SET
from pipeline.results.sets import Geometry

LINE = Geometry((False,), (1.0,))
PLANE = Geometry((False, False), (1.0, 1.0))
LOGISTIC = (3.0, 3.449489743, 3.544090359, 3.564407266, 3.568759420)
"""Doublings of the logistic map; its cascade accumulates at 3.569945672 (Feigenbaum, J. Stat. Phys. 19, 25, 1978)."""
CRITICALITIES = ("none", "supercritical", "subcritical")


def located(values: tuple[float, ...], orbit: np.ndarray, kind: str = DOUBLING, degree: str = "supercritical"):
    """Return bifurcations; the k-th leads from branch k to branch k + 1, and the last has an orbit (point, state)."""
    n = len(values)
    section = np.full((n, *orbit.shape), np.nan)
    section[-1] = orbit
    variables = {
        "value": values,
        "of_branch": np.arange(n),
        "to_branch": np.arange(1, n + 1),
        "n_unstable_before": np.zeros(n, int),
        "n_unstable_after": np.ones(n, int),
        "bracket": np.full(n, 1e-9),
    }
    ds = xr.Dataset({name: ("bifurcation", np.asarray(v)) for name, v in variables.items()}, attrs={"parameter": "r"})
    for name, words, code in (("kind", KINDS, KINDS.index(kind)), ("criticality", CRITICALITIES, 0)):
        code = CRITICALITIES.index(degree) if name == "criticality" else code
        ds[name] = ("bifurcation", np.full(n, code), code_flags(words))
    return ds.assign(bifurcation_section=(("bifurcation", "phase", "state"), section))


def logistic_set(r: float, n: int = 2000) -> np.ndarray:
    x, found = 0.4, np.empty((n, 1))
    for i in range(-500, n):
        x = r * x * (1.0 - x)
        found[max(i, 0), 0] = x
    return found


ORBIT = logistic_set(3.5686, 16)
"""Orbit of period 16 next to its doubling; near the limit chaos has as many bands."""


def test_cascade_of__the_logistic_map_has_its_published_limit() -> None:
    ds = located(LOGISTIC, ORBIT)
    found = cascade_of(ds, Fate(3.0, bifurcation=2), (3.5, 3.5702), logistic_set(3.5702), LINE)
    assert found.what == CASCADE
    assert found.value == pytest.approx(3.5699456, abs=5e-7)
    assert abs(found.value - 3.569945672) <= found.error
    assert found.ratio == pytest.approx(DELTA, abs=0.02)
    assert found.doublings == LOGISTIC


def test_cascade_of__along_a_falling_parameter() -> None:
    ds = located(tuple(-v for v in LOGISTIC), ORBIT)
    found = cascade_of(ds, Fate(-3.0, bifurcation=0), (-3.5, -3.5702), logistic_set(3.5702), LINE)
    assert (found.what, found.value) == (CASCADE, pytest.approx(-3.5699456, abs=2e-6))


@pytest.mark.parametrize(
    ("values", "bracket", "points", "words"),
    [
        (LOGISTIC[:2], (3.5, 3.5702), logistic_set(3.5702), "a cascade needs three doublings"),
        ((3.0, 3.4, 3.5, 3.55), (3.5, 3.6), logistic_set(3.6), "the ratio is not near 4.6692"),
        (LOGISTIC, (3.5, 3.569), logistic_set(3.569), "the limit lies outside of r = 3.5, 3.569"),
        (LOGISTIC, (3.5, 3.8), logistic_set(3.8), "seen so far from the limit that crises may lie between"),
        (LOGISTIC, (3.5, 3.5702), logistic_set(3.5702) + 0.5, "size away from the last orbit"),
    ],
)
def test_cascade_of__what_is_missing_is_said(values, bracket, points, words) -> None:
    found = cascade_of(located(values, ORBIT), Fate(3.0, bifurcation=0), bracket, points, LINE)
    assert found.what == ""
    assert words in found.why


def test_chain__begins_with_the_first_doubling_wherever_it_is_entered() -> None:
    ds = located(LOGISTIC, ORBIT)
    assert [_chain(ds, k) for k in (0, 3, 4)] == [[0, 1, 2, 3, 4]] * 3
    assert _chain(ds, -1) == []
    ds["kind"][2] = KINDS.index(TORUS)
    assert _chain(ds, 1) == [0, 1]
    assert _chain(ds, 2) == []


def circle(radius: float) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(400) / 400.0
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


@pytest.mark.parametrize(("power", "what"), [(0.5, TORUS), (1.0, ""), (0.0, "")])
def test_torus_of__shrinks_as_the_root_of_the_distance(power: float, what: str) -> None:
    """At a supercritical Neimark-Sacker point at 1.0; the radius is a power of the distance from it."""
    ds = located((1.0,), np.zeros((1, 2)), TORUS)
    tori = [circle((value - 1.0) ** power) for value in (1.02, 1.08)]
    found = torus_of(ds, Fate(1.0, bifurcation=0), (0.9, 1.02, 1.08), tori, PLANE)
    assert found.what == what
    if what:
        assert (found.value, found.error) == (1.0, 1e-9)


@pytest.mark.parametrize(
    ("kind", "degree", "bracket"),
    [
        (TORUS, "subcritical", (0.9, 1.02, 1.08)),
        (DOUBLING, "supercritical", (0.9, 1.02, 1.08)),
        (TORUS, "supercritical", (1.01, 1.02, 1.08)),  # the point lies beyond the values of the run
    ],
)
def test_torus_of__needs_a_supercritical_point_in_the_bracket(kind, degree, bracket) -> None:
    ds = located((1.0,), np.zeros((1, 2)), kind, degree)
    tori = [circle(np.sqrt(0.02)), circle(np.sqrt(0.08))]
    assert torus_of(ds, Fate(1.0, bifurcation=0), bracket, tori, PLANE).what == ""


def judged(monkeypatch, kind_at, ends: tuple[float, float] = (0.0, 1.0)):
    """Judge a break-up by a rule for the kind of the set at a value."""
    monkeypatch.setattr(breakups, "_found", lambda along, value, *given: _Found(kind_at(value), 0.25))
    return breakup_of(xr.Dataset(attrs={"parameter": "mu"}), None, ends, [])


@pytest.mark.parametrize("ends", [(0.0, 1.0), (1.0, 0.0)])
def test_breakup_of__halves_around_the_value(monkeypatch, ends) -> None:
    """Three rounds divide the interval by 16 each."""
    at, rises = 0.618, ends[0] < ends[1]
    found = judged(monkeypatch, lambda x: TORUS_SET if (x < at) == rises else CHAOTIC_SET, ends)
    assert found.what == BREAKUP
    assert found.error == pytest.approx(0.5 / 16**3)
    assert abs(found.value - at) <= found.error
    assert "by 45 further values" in found.why
    assert "largest exponent 0.25 per section" in found.why


def test_breakup_of__locking_between_leaves_it_open(monkeypatch) -> None:
    def kind_at(x: float) -> int:
        return TORUS_SET if x < 0.4 else LOCKED if x < 0.6 else CHAOTIC_SET

    found = judged(monkeypatch, kind_at)
    assert found.what == ""
    assert "a torus up to mu = 0.375 and chaotic from mu = 0.625 on" in found.why
    assert "locked at mu = 0.4375, 0.5, 0.5625" in found.why


def test_breakup_of__few_values_too_near_to_tell_are_no_obstacle(monkeypatch) -> None:
    def kind_at(x: float) -> int:
        return TORUS_SET if x < 0.49 else BOUNDED_SET if x < 0.51 else CHAOTIC_SET

    found = judged(monkeypatch, kind_at)
    assert found.what == BREAKUP
    assert abs(found.value - 0.5) <= found.error
    assert found.error == pytest.approx(1.0 / 16.0)

    wide = judged(monkeypatch, lambda x: TORUS_SET if x < 0.4 else BOUNDED_SET if x < 0.6 else CHAOTIC_SET)
    assert wide.what == ""
    assert "none of these at" in wide.why
