"""Decide whether a torus breaks up into a chaotic set between two values of a run.

A smooth torus loses its smoothness within a tongue of locking before it is chaotic (Afraimovich and Shilnikov, Amer.
Math. Soc. Transl. 149, 1991, 201), so that tori, locked orbits and chaos often alternate. Further values between the
two tell: the set is named as broken up there if it is a torus up to one value, chaotic from the next one on, and locked
at none, whether its trajectories start on the torus or on the chaotic set. Windows of locking that are narrower
than the distance of these values are not seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from magpend_core.engine.placeholders import no_forcing
from magpend_core.orbits import section_map
from pipeline.analysis.attractors.extension.growth import growth_of, kind_of
from pipeline.analysis.events.contact import SectionMap, map_along
from pipeline.analysis.events.kinds import BREAKUP, UNDECIDED
from pipeline.analysis.events.lines import at
from pipeline.analysis.events.scene import Born, Event, Scene, Stretch, opposite_ends
from pipeline.layout.vocabulary import BOUNDED_SET, CHAOTIC_SET, TORUS
from pipeline.results.ragged import points_of_rows


@dataclass(frozen=True)
class BreakupSettings:
    """Numbers of the search for the value at which a torus breaks up."""

    # further values in each round, and rounds, each between the last torus and the first chaotic set of the one before:
    # more find the value more exactly, and take longer
    values: int = 15
    rounds: int = 3
    # most values of a round whose sets are neither tori nor chaotic nor locked: too near to the break-up to tell
    most_open: int = 2
    # sections of each trajectory before it counts, and those along which its exponents are computed
    transient: int = 1000
    length: int = 2048


LOCKED, DIFFERENT = -1, -2
"""Codes beside the kinds of sets: trajectories converge to an orbit; those of both starts differ."""

WORDS = {
    LOCKED: "locked",
    CHAOTIC_SET: "chaotic",
    TORUS: "a torus",
    BOUNDED_SET: "none of these",
    DIFFERENT: "different from the two starts",
}
"""Words for the sets between a torus and a chaotic set."""


@dataclass(frozen=True)
class _Found:
    """Kind of the set at a value, or a code of `LOCKED` and `DIFFERENT`, and its largest exponent per section."""

    kind: int
    rate: float


def name_breakup(scene: Scene, one: Event, named: Sequence[Event]) -> Event:
    """Name the end of a torus or of a chaotic set whose cells go on to the other kind of set, or say what was met
    between the two.
    """
    others = [other.stretch for other in opposite_ends(one, named) if len(one.to) == len(other.to) == 1]
    if not others or {one.stretch.kind, others[0].kind} != {TORUS, CHAOTIC_SET}:
        return one
    torus, chaos = sorted((one.stretch, others[0]), key=lambda stretch: stretch.kind != TORUS)
    if (torus, chaos) not in scene.verdicts:
        scene.verdicts[torus, chaos] = _between(scene, torus, chaos, rises=one.rises == (torus is one.stretch))
    found = scene.verdicts[torus, chaos]
    fate = replace(one.fate, value=found.value, bifurcation=-1, why=found.why)
    return replace(one, fate=fate, what=found.what or UNDECIDED, error=found.error, born=found)


def _between(scene: Scene, torus: Stretch, chaos: Stretch, rises: bool) -> Born:
    """Judge the interval between a torus and a chaotic set; `rises` if the parameter rises from the torus on."""
    ends, points = ((torus, rises), (chaos, not rises)), points_of_rows(scene.attractors)
    values = tuple(float(scene.along[one.places[end]]) for one, end in ends)
    sets = tuple(points[one.rows[end]] for one, end in ends)
    return breakup_of(scene.located, map_along(scene, torus.places[rises]), values, sets)


def breakup_of(
    ds: xr.Dataset,
    along: SectionMap,
    values: Sequence[float],
    sets: Sequence[np.ndarray],
    settings: BreakupSettings = BreakupSettings(),
) -> Born:
    """Judge whether a torus breaks up into a chaotic set between two parameter values.

    Parameters
    ----------
    ds
        Located branches, which name the parameter.
    along
        Section map along the parameter.
    values
        Values of the run on the torus and on the chaotic set.
    sets
        Section points of the two, shape (n, state).
    settings
        Numbers to choose.

    Returns
    -------
    Born
        The value is the middle of the interval between the last torus and the first chaotic set, the error half its
        length.
    """
    (torus, chaos), n, rate = values, 0, np.nan
    for _ in range(settings.rounds):
        between = np.linspace(torus, chaos, settings.values + 2)[1:-1]
        found = [_found(along, x, sets, settings) for x in between]
        n += len(between)
        kinds = np.array([one.kind for one in found])
        first = int(np.argmin([*(kinds == TORUS), False]))
        last = len(kinds) - int(np.argmin([*(kinds[::-1] == CHAOTIC_SET), False]))
        torus, chaos = [torus, *between][first], [*between, chaos][last]
        rate = found[last].rate if last < len(found) else rate
        told = f"by {n} further values it is a torus up to {at(ds, torus)} and chaotic from {at(ds, chaos)} on"
        if (kinds[first:last] != BOUNDED_SET).any() or last - first > settings.most_open:
            listed = _listed(ds, between[first:last], found[first:last])
            return Born("", f"whether the torus breaks up is open: {told}; between, it is {listed}")
        if first < last:
            break
    told = f"{told} (largest exponent {rate:.3g} per section), and locked at none"
    return Born(BREAKUP, told, float(0.5 * (torus + chaos)), float(0.5 * abs(chaos - torus)))


def _listed(ds: xr.Dataset, values: np.ndarray, found: list[_Found]) -> str:
    """Write the values by the kind of the set there."""
    parts = []
    for kind, word in WORDS.items():
        own = [float(x) for x, one in zip(values, found, strict=True) if one.kind == kind]
        parts += [f"{word} at {at(ds, *own)}"] if own else []
    return "; ".join(parts)


def _found(along: SectionMap, value: float, sets: Sequence[np.ndarray], settings: BreakupSettings) -> _Found:
    """Return the kind of the set at a value, from a trajectory that starts on each of two sets."""
    paths = along.paths(value, np.array([points[-1] for points in sets]), settings.transient + settings.length)[
        :, settings.transient :
    ]
    first, second = (_kind(along, value, path) for path in paths)
    return first if first.kind == second.kind else _Found(DIFFERENT, max(first.rate, second.rate))


def _kind(along: SectionMap, value: float, path: np.ndarray) -> _Found:
    """Return the kind of the set on which a trajectory of section points runs."""
    if not np.isfinite(path).all():
        return _Found(BOUNDED_SET, np.nan)
    system, rows = along.family.system, along.rows(value, path[:-1])
    ends = section_map(rows.parameters, rows.frequency_hz, rows.states, 1, rtol=along.rtol, system=system)
    is_at_even_times = system.forcing is no_forcing and not system.is_map and system.section is None
    slopes = along.family.scaled(ends.derivatives)
    growth = growth_of(slopes[None], int(is_at_even_times), np.zeros((1, len(slopes))))
    kind = LOCKED if growth.contracts else kind_of(growth, path[::2], along.geometry)
    return _Found(kind, growth.rate)
