"""Join attractors and branches to events."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pkgutil import resolve_name

import numpy as np
import xarray as xr

from magpend_core.models.model import Parameters
from pipeline.analysis.attractors.matching import geometry_of
from pipeline.analysis.branches.intervals import interval_along, settle_along, swept_axis
from pipeline.analysis.branches.kinds import FOLD, KINDS, SNIC
from pipeline.analysis.events.crises import Crises
from pipeline.analysis.events.dataset import dataset_of
from pipeline.analysis.events.declaration import EventOptions
from pipeline.analysis.events.kinds import EVENTS, LIVES_ON, RANGE_END, UNDECIDED, detectors_of
from pipeline.analysis.events.lines import (
    AT_BRANCH_POINT,
    CROSSING,
    LOCATED,
    Fate,
    Orbit,
    Place,
    at,
    bifurcation_at,
    crossing_at,
    error_at,
    follow,
    lines_of,
    places_of,
)
from pipeline.analysis.events.one_event import are_mirrored, is_at_one_value, on_circle, with_images
from pipeline.analysis.events.refinement import refined
from pipeline.analysis.events.scene import Event, Scene, Stretch, orbit_beyond
from pipeline.layout.vocabulary import (
    APERIODIC,
    ATTRACTS,
    CHAOTIC_SET,
    EQUILIBRIUM,
    FREQUENCY_DIM,
    PERIODIC_ORBIT,
    TORUS,
    axis_name,
    frequency_of,
    letter,
    parameter_name,
    parameters_of,
)
from pipeline.layout.vocabulary import KINDS as SETS
from pipeline.products.reporting import silent, track
from pipeline.results.outcomes import outcomes
from pipeline.results.ragged import isel, points_of_rows, rows_at
from pipeline.results.run import OpenRun
from pipeline.results.selection import choose, select_points, start_dims
from pipeline.results.tabular import plain

_AT_EVEN_TIMES = "a limit cycle seen at even times has no branch; see it at crossings: [section] of a new run"


def settle_events(run: OpenRun, options: EventOptions) -> EventOptions:
    """Return the options; raise SpecError unless the run sweeps the parameter, and has branches along it."""
    from pipeline.specification.problems import SpecError

    parameter, axis = options.parameter, swept_axis(run, options.parameter)
    if axis is None:
        raise SpecError(f"events lie along a swept parameter, and the run does not sweep {parameter}.")
    settle_along(run, options)
    low, high = interval_along(run, parameter)
    if int(((axis.values >= low) & (axis.values <= high)).sum()) < 2:
        raise SpecError(
            f"the branches are those from {low} to {high}, and the run has fewer than two values of {parameter} there; "
            "find them in a wider interval: magpend analyse branches DIR, --from and --to."
        )
    return options


def needs_one_axis(run: OpenRun, options: EventOptions) -> None:
    """Raise ValueError unless `at` leaves one value of each axis beside the parameter's."""
    cube, axis = run.cube(), axis_name(options.parameter)
    if axis in cube.dims:
        select_points(cube.isel({axis: slice(0, 1)}), options.at, purpose=f"events lie along {parameter_name(axis)}")


def events(run: OpenRun, options: EventOptions) -> xr.Dataset:
    """Name the events at the ends of all attractors of a run along a parameter."""
    if options.refine:
        return refined(run, options)
    found, axis = run.derive("attractors"), axis_name(options.parameter)
    located = run.derive("branches", parameter=options.parameter)
    part = choose(found, options.at, (axis, *start_dims(found)), f"events lie along {parameter_name(axis)}")
    low, high = interval_along(run, options.parameter)
    inside = (part[axis].values >= low) & (part[axis].values <= high)
    part = isel(part, {axis: np.flatnonzero(inside)})
    length = float(np.ptp(part[axis].values))
    return ends_of(part, located, axis, parameters_of(run.cube()), length, orbits=options.orbits, echo=run.echo)


def ends_of(
    part: xr.Dataset,
    located: xr.Dataset,
    axis: str,
    base: Parameters,
    scale: float,
    *,
    orbits: bool = False,
    between: tuple[float, float] | None = None,
    echo: Callable[[str], None] = silent,
) -> xr.Dataset:
    """Name the events at the ends of attractors along one axis, given the branches there.

    Parameters
    ----------
    part
        Attractors along the axis, at one value of each other parameter, with plain names.
    located
        From `pipeline.analysis.branches.dataset.dataset_of`, along the same parameter.
    axis
        Name of the axis.
    base
        Parameters of the run, apart from those on its axes.
    scale
        Length of the axis that the run sweeps: errors of located bifurcations are at least a share of it.
    orbits
        Whether to leave the ends of chaotic sets and tori undecided.
    between
        Neighbouring values between which the ends of chaotic sets and tori are decided; None: between all.
    echo
        Function that prints a line.
    """
    geometry = geometry_of(part)
    others = base.as_dict() | {parameter_name(str(k)): float(v) for k, v in part.coords.items() if not v.ndim}
    others |= {parameter_name(FREQUENCY_DIM): frequency_of(base.model, {k: float(v) for k, v in _scalars(part)})}
    order = np.argsort(part[axis].values, kind="stable")
    scene = Scene(part, located, axis, base, order, scale, lines_of(located, others, geometry), between=between)
    stretches, ids = _continued(scene, [_undoubled(scene, one) for one in _stretches(scene)])
    if not orbits:
        stretches = Crises(replace(scene, names=ids)).split(stretches)
    echo(f"events: {len(stretches)} stretches of attractors, {len(scene.lines)} branches")
    stretches, fates, names = _joined(*_cut(scene, stretches))
    stretches.sort(key=lambda one: (one.attractor, one.places))
    names = {(place, i): names.get((place, name), name) for (place, i), name in ids.items()}
    scene = replace(scene, names=names)
    named = [_event(scene, one, rises, fates[one, rises][rises]) for one in stretches for rises in (False, True)]
    named = [_on_circle(scene, one, named) for one in named]
    if not orbits:
        named = [_aperiodic(scene, one, named) for one in track(named, "naming ends of attractors")]
    return dataset_of(scene, stretches, _merged(with_images(scene, named)))


def _scalars(part: xr.Dataset) -> list[tuple[str, float]]:
    return [(str(k), v) for k, v in part.coords.items() if not v.ndim and np.issubdtype(v.dtype, np.number)]


def _stretches(scene: Scene) -> list[Stretch]:
    """Return the stretches of all attractors, by id and rising value."""
    ds, rows = scene.attractors, rows_at(scene.attractors)
    own = {name: ds[name].values for name in ("attractor", "kind", "orbit_period", "stability")}
    found: dict[int, list[Stretch]] = {}
    for place, index in enumerate(scene.order.tolist()):
        for row in rows[(index,)]:
            if own["stability"][row] != ATTRACTS:
                continue
            number, kind, period = (int(own[name][row]) for name in ("attractor", "kind", "orbit_period"))
            of_id = found.setdefault(number, [])
            one = Stretch(number, kind, period, (place, place), (row, row))
            if of_id and of_id[-1].places[1] == place - 1 and (of_id[-1].kind, of_id[-1].period) == (kind, period):
                last = of_id.pop()
                one = replace(last, places=(last.places[0], place), rows=(last.rows[0], row))
            of_id.append(one)
    return [one for number in sorted(found) for one in found[number]]


def _continued(scene: Scene, stretches: Sequence[Stretch]) -> tuple[list[Stretch], dict[tuple[int, int], int]]:
    """Join neighbouring chaotic sets whose cells all go on to each other: ids of such sets rest on distance alone.

    Return also the id of the joined stretch by the place and the id of each one.
    """
    names = {(place, one.attractor): one.attractor for one in stretches for place in _places(one)}
    scene = replace(scene, names=names)
    joined: list[Stretch] = []
    found = dict(names)
    for one in sorted(stretches, key=lambda one: one.places):
        k = next((k for k, before in enumerate(joined) if _is_continued(scene, before, one)), -1)
        if k < 0:
            joined.append(one)
            continue
        before = joined[k]
        joined[k] = replace(before, places=(before.places[0], one.places[1]), rows=(before.rows[0], one.rows[1]))
        found |= {(place, one.attractor): before.attractor for place in _places(one)}
    return joined, found


def _places(one: Stretch) -> range:
    return range(one.places[0], one.places[1] + 1)


def _is_continued(scene: Scene, before: Stretch, after: Stretch) -> bool:
    """Tell whether a chaotic set follows another one at the next value, and all cells of each go on to the other."""
    is_chaotic = {SETS[one.kind] for one in (before, after)} == {"chaotic_set"}
    if not is_chaotic or before.places[1] + 1 != after.places[0]:
        return False
    ids = [int(scene.attractors["attractor"].values[row]) for row in (before.rows[1], after.rows[0])]
    here, there = before.places[1], after.places[0]
    up, _ = _cells(scene, ids[0], True, here, there)
    down, _ = _cells(scene, ids[1], False, there, here)
    return set(up) - {-1} == {ids[1]} and set(down) - {-1} == {ids[0]}


Fates = dict[tuple[Stretch, bool], tuple[Fate, Fate]]
"""Fates of the orbits at the first (False) and the last value of stretches, as the parameter falls and rises."""


def _fates(scene: Scene, stretches: Sequence[Stretch]) -> Fates:
    """Follow the orbits at both ends of each stretch along their branches."""
    ds, points = scene.attractors, points_of_rows(scene.attractors)
    fates: Fates = {}
    asked, orbits = [], []
    for one in stretches:
        for rises in (False, True):
            row, place = one.rows[rises], one.places[rises]
            why = ""
            if not one.period and one.kind != EQUILIBRIUM:
                why = _AT_EVEN_TIMES if one.kind == PERIODIC_ORBIT else "no orbit to follow"
            elif not ds["is_polished"].values[row]:
                why = "Newton's method found no orbit there"
            if why:
                fates[one, rises] = (Fate(np.nan, why=why),) * 2
                continue
            asked.append((one, rises))
            orbits.append(Orbit(scene.family(place, one.period), points[row][0], float(scene.along[place])))
    for key, found in zip(asked, places_of(orbits, scene.lines, geometry_of(ds)), strict=True):
        found = found or _bifurcation_at(scene, *key, key[0].period)
        if found is None:
            fates[key] = (Fate(np.nan, why=_not_followed(scene, *key)),) * 2
        else:
            fates[key] = follow(scene.located, found, -1), follow(scene.located, found, 1)
    return fates


def _bifurcation_at(scene: Scene, one: Stretch, rises: bool, period: int) -> Place | None:
    """Find a bifurcation of orbits of a period at which the orbit at an end of a stretch lies."""
    value, points = float(scene.along[one.places[rises]]), points_of_rows(scene.attractors)[one.rows[rises]]
    geometry, own = geometry_of(scene.attractors), [line for line in scene.lines if line.period == period]
    found = (bifurcation_at(scene.located, line, value, points, geometry, scene.scale) for line in own)
    return next((place for place in found if place is not None), None)


def _undoubled(scene: Scene, one: Stretch) -> Stretch:
    """Halve the period of an orbit that is seen at the very value of its doubling, where cells still alternate."""
    is_alone = one.places[0] == one.places[1] and one.period and one.period % 2 == 0
    is_double = is_alone and _bifurcation_at(scene, one, False, one.period // 2) is not None
    return replace(one, period=one.period // 2) if is_double else one


def _not_followed(scene: Scene, one: Stretch, rises: bool) -> str:
    """Say that no branch has the orbit at an end of a stretch, and which bifurcations lie at its value."""
    ds, value, why = scene.located, float(scene.along[one.places[rises]]), "no branch has this orbit as a stable one"
    near = [k for k, x in enumerate(ds["value"].values) if abs(x - value) <= error_at(ds, k, scene.scale)]
    if near:
        kinds = dict.fromkeys(plain(KINDS[int(ds["kind"].values[k])]) for k in near)
        return f"{why}, and it is not the orbit of the {' or '.join(kinds)} at {at(ds, value)}"
    return f"{why} (--period, --recurrences)"


def _cut(scene: Scene, stretches: Sequence[Stretch]) -> tuple[list[Stretch], Fates]:
    """Cut stretches where a bifurcation ends the branch of their first or last orbit: ids of orbits rest on distance,
    so that one id may run over several stable pieces of branches.

    Return also the fates of the orbits at the ends of each part.
    """
    kept: Fates = {}
    asked = list(stretches)
    while asked:
        fates = _fates(scene, asked)
        parts = [parts_of(scene, one, fates) for one in asked]
        kept |= {
            (one, rises): fate
            for known, _ in parts
            for one, pair in known
            for rises, fate in zip((False, True), pair, strict=True)
        }
        asked = [one for _, others in parts for one in others]
    return [one for one, rises in kept if rises], kept


Known = tuple[Stretch, tuple[tuple[Fate, Fate], tuple[Fate, Fate]]]
"""A stretch with the fates at its first and its last value."""


def parts_of(scene: Scene, one: Stretch, fates: Fates) -> tuple[list[Known], list[Stretch]]:
    """Return the parts of a stretch on the pieces of its first and its last orbit, and parts between them."""
    first, last = fates[one, False], fates[one, True]
    pieces = _piece(*first), _piece(*last)
    along, near = scene.along[one.places[0] : one.places[1] + 1], AT_BRANCH_POINT * scene.scale
    top, bottom = first[1].reach(np.inf), last[0].reach(-np.inf)
    is_cut = along[0] - near <= top < along[-1] - near, along[0] + near < bottom <= along[-1] + near
    n, is_one = len(along), pieces[0] == pieces[1] or not all(pieces)
    if n > 1 and not is_one and (top > bottom + near or not any(is_cut)):
        return [], [_part(scene, one, 0, n // 2), _part(scene, one, n // 2, n)]  # both pieces exist at some values
    if not any(is_cut) or (is_one and all(pieces)):
        return [(one, (first, last))], []
    left = int((along <= top + near).sum()) if is_cut[0] else 0
    right = max(int((along < bottom - near).sum()), left) if is_cut[1] else n
    known = [(_part(scene, one, 0, left), (first, first))] if left else []
    known += [(_part(scene, one, right, n), (last, last))] if right < n else []
    return known, [_part(scene, one, left, right)] if right > left else []


def _part(scene: Scene, one: Stretch, begin: int, end: int) -> Stretch:
    """Return the part of a stretch from one of its values up to another one, which does not belong to it."""
    places = one.places[0] + begin, one.places[0] + end - 1
    if places == one.places:
        return one
    ds, rows = scene.attractors, rows_at(scene.attractors)
    own = (
        next(row for row in rows[(int(scene.order[place]),)] if ds["attractor"].values[row] == one.attractor)
        for place in places
    )
    return replace(one, places=places, rows=(next(own), next(own)))


def _joined(stretches: Sequence[Stretch], fates: Fates) -> tuple[list[Stretch], Fates, dict[tuple[int, int], int]]:
    """Join stretches that lie on one stable piece of a branch: they are one attractor, also where no cell ends on it
    in between, or where it has two ids, as ids of equilibria rest on distance.

    Return also the id of the joined stretch by the place and the id of each one.
    """
    joined: list[Stretch] = []
    names: dict[tuple[int, int], int] = {}
    kept: Fates = {}
    open_ends: dict[tuple[int, ...], int] = {}  # by piece, the stretch that reaches furthest
    for one in sorted(stretches, key=lambda one: one.places):
        left, right = (_piece(*fates[one, rises]) for rises in (False, True))
        k = open_ends.get((*left, one.period), -1) if left else -1
        if k >= 0 and joined[k].places[1] < one.places[0]:
            before = joined[k]
            whole = replace(before, places=(before.places[0], one.places[1]), rows=(before.rows[0], one.rows[1]))
            kept[whole, False], kept[whole, True] = kept[before, False], fates[one, True]
            joined[k] = whole
        else:
            kept[one, False], kept[one, True] = fates[one, False], fates[one, True]
            joined.append(one)
            k = len(joined) - 1
        if right:
            open_ends[(*right, one.period)] = k
        names |= {(place, one.attractor): joined[k].attractor for place in _places(one)}
    return joined, kept, names


def _piece(down: Fate, up: Fate) -> tuple[int, ...]:
    """Return what tells a stable piece of a branch: the branch and the nodes at which it ends; empty if unknown."""
    return (up.branch, *sorted((down.node, up.node))) if up.branch >= 0 else ()


def _event(scene: Scene, one: Stretch, rises: bool, fate: Fate) -> Event:
    """Name the end of a stretch by the fate of its orbit, and say on which attractors its cells go on."""
    place, way = one.places[rises], 1 if rises else -1
    beyond = place + way
    if not 0 <= beyond < len(scene.along):
        _, n_cells = _cells(scene, one.attractor, rises, place, place)
        return Event(one, rises, replace(fate, value=float(scene.along[place])), RANGE_END, n_cells=n_cells)
    event = _named(scene, Event(one, rises, fate, beyond=beyond))
    if abs(scene.along[beyond] - event.fate.value) <= event.error and 0 <= beyond + way < len(scene.along):
        beyond += way
    to, n_cells = _cells(scene, one.attractor, rises, place, beyond)
    return replace(event, beyond=beyond, to=to, n_cells=n_cells)


def _named(scene: Scene, event: Event) -> Event:
    """Name the end of an orbit by the bifurcation or the limit at which its branch ends."""
    fate = event.fate
    if fate.is_bound:
        return replace(event, what=LIVES_ON)
    if fate.limit:
        return replace(event, what=fate.limit, error=max(fate.error, LOCATED * scene.scale))
    if fate.bifurcation < 0:
        return event if event.stretch.kind in APERIODIC else _detected(scene, event, ())
    ds, k = scene.located, fate.bifurcation
    sides = ds["n_unstable_before"].values[k], ds["n_unstable_after"].values[k]
    if int(ds["of_branch"].values[k]) == fate.branch and (min(sides) != 0 or max(sides) == 0):
        why = f"{fate.why} at {at(ds, fate.value)}, whose numbers of unstable multipliers contradict it"
        return replace(event, fate=replace(fate, value=np.nan, bifurcation=-1, why=why))
    kind = int(ds["kind"].values[k])
    what = crossing_at(ds, scene.lines, k) if kind in CROSSING else KINDS[kind]
    return replace(event, what=what, error=error_at(ds, k, scene.scale))


def _detected(scene: Scene, one: Event, named: Sequence[Event]) -> Event:
    """Let the detectors of the kinds of events name an end, until one does."""
    for place in detectors_of(SETS[one.stretch.kind]):
        if one.what == UNDECIDED:
            one = resolve_name(place)(scene, one, named)
    return one


def _on_circle(scene: Scene, one: Event, named: Sequence[Event]) -> Event:
    """Name the fold of an equilibrium, or of its mirror image, by the cycle that begins there, if there is one."""
    if (one.what, one.stretch.kind) != (FOLD, EQUILIBRIUM):
        return one
    images = [one, *(other for other in named if other.what == FOLD and are_mirrored(scene, one, other))]
    found = any(on_circle(scene, image, cycle) for image in images for cycle in named if cycle.what == SNIC)
    return replace(one, what=SNIC) if found else one


def _cells(scene: Scene, attractor: int, rises: bool, place: int, beyond: int) -> tuple[dict[int, int], int]:
    """Count the cells of an attractor by the id on which cells of the same start end at the next value.

    In a continuation only branches in this direction of the parameter count.
    """
    ds = scene.attractors
    ids = outcomes(ds).transpose(scene.axis, ...).values[scene.order]
    here = np.isin(ids[place], scene.ids_of(attractor, place))
    if "direction" in ds.coords and start_dims(ds) == ["branch"]:
        here &= ds["direction"].values == ("up" if rises else "down")
    counts = Counter(scene.names.get((beyond, i), i) for i in ids[beyond][here].tolist())
    return dict(counts.most_common()), int(here.sum())


def _aperiodic(scene: Scene, one: Event, named: Sequence[Event]) -> Event:
    """Name the end of a chaotic set or a torus by the end of the orbit that its cells go on to, or by what happens
    between the two values, if there is proof.
    """
    is_open = one.what == UNDECIDED and one.stretch.kind in (TORUS, CHAOTIC_SET)
    if not is_open or not scene.is_asked(one.place, one.way):
        return one
    if orbit_beyond(one, named) is None:
        one = replace(one, fate=replace(one.fate, why=_why_open(one, named)))
    return _detected(scene, one, named)


def _why_open(one: Event, named: Sequence[Event]) -> str:
    """Say why no orbit tells the end of a chaotic set or a torus."""
    heir = next(iter(one.to), -1)
    beyond = [other.stretch for other in named if other.stretch.attractor == heir]
    if any(other.kind == one.stretch.kind for other in beyond):
        return f"{letter(heir)} is a {plain(SETS[one.stretch.kind])} too and may be the same: such ids rest on distance"
    if any(SETS[other.kind] == "chaotic_set" for other in beyond):
        return f"{letter(heir)} is a chaotic set, but the cells of the two do not all go on to each other"
    if len(one.to) > 1:
        return "its cells do not all go on to the same attractor"
    return "its cells do not go on to an orbit whose end is located and whose cells go on to it"


def _merged(named: Sequence[Event]) -> list[Event]:
    """Make one event of two ends of an attractor at one bifurcation or crisis: it changes its period or size there."""
    merged: list[Event] = []
    for one in named:
        last = merged[-1] if merged else None
        if (
            last is not None
            and (last.rises, one.rises) == (True, False)
            and last.stretch.attractor == one.stretch.attractor
            and (
                last.fate.bifurcation == one.fate.bifurcation >= 0
                or (EVENTS[one.what].two_sided and last.what == one.what and is_at_one_value(last, one))
            )
        ):
            merged[-1] = replace(last, after=one.stretch)
        else:
            merged.append(one)
    return merged
