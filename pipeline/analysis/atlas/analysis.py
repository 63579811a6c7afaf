"""Define the atlas of a run that sweeps two parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import xarray as xr

from pipeline.analysis.atlas.charting import Chart, Located, charted, others_unstable
from pipeline.analysis.atlas.dataset import ends_dataset, of_changes, of_curves, of_lines, of_searched
from pipeline.analysis.atlas.declaration import AtlasOptions, PlaneOptions, SetEndOptions
from pipeline.analysis.atlas.effects import Crossings, crossings, effects_of
from pipeline.analysis.atlas.ends import End, at_node, follow_all, start_of
from pipeline.analysis.atlas.further import Wanted, wanted, with_further
from pipeline.analysis.atlas.further import dataset_of as further_dataset
from pipeline.analysis.atlas.lines import Key, Line, lines_through
from pipeline.analysis.atlas.plane import Array, Change, Plane, changes_of, continued, pairs_on, plane_of
from pipeline.analysis.atlas.regions import variables_of_regions
from pipeline.analysis.atlas.searching import Searched, followed_from, nodes_for, searched_at
from pipeline.analysis.atlas.verdicts import Verdict, verdicts
from pipeline.analysis.atlas.windows import carried, chosen, named, set_lines
from pipeline.analysis.branches.curves import curves_dataset
from pipeline.analysis.branches.intervals import in_words, swept_axis
from pipeline.analysis.branches.kinds import HOMOCLINIC, KINDS, SNIC
from pipeline.analysis.branches.problems import FREQUENCY, Family
from pipeline.analysis.events.kinds import LIVES_ON, UNDECIDED
from pipeline.layout.vocabulary import APERIODIC, axis_name, parameters_of
from pipeline.products.reporting import track
from pipeline.results.run import OpenRun
from pipeline.specification.problems import SpecError

Given = TypeVar("Given", bound=PlaneOptions)

MARGIN = 0.06
"""Width beyond the plane up to which curves are followed, in units of the plane: more than their longest step."""


# ---- options -----------------------------------------------------------------------------------


def settle_plane(run: OpenRun, options: Given) -> Given:
    """Return the options; raise SpecError unless the run is a sweep over both parameters."""
    names = options.parameter, options.second
    for name in names:
        if "branch" in run.cube().dims or swept_axis(run, name) is None:
            raise SpecError(
                f"an atlas needs a sweep over two parameters; {in_words(run, name)} is not swept (see [axes])."
            )
    if axis_name(names[0]) == axis_name(names[1]):
        raise SpecError(f"--parameter and --second are both {in_words(run, names[0])}; give two parameters.")
    known = {axis_name(name) for name in (*names, *options.at)}
    for name in run.spec.axes:
        if axis_name(name) not in known and (axis := swept_axis(run, name)) is not None:
            told = f"the run also sweeps {in_words(run, name)} ({axis.size} values)"
            raise SpecError(f"{told}; choose one of them: --at {in_words(run, name)}=VALUE.")
    return options


def _plane(run: OpenRun, options: PlaneOptions) -> Plane:
    """Return the plane of a run, with its further points."""
    plane = plane_of(run.derive("attractors"), (axis_name(options.parameter), axis_name(options.second)), options.at)
    if not options.budget:
        return plane
    more = run.derive("further", **options.part(PlaneOptions))
    return with_further(plane, more, run.model.system) if more.sizes["further"] else plane


def further(run: OpenRun, options: PlaneOptions) -> xr.Dataset:
    """Run further points until the budget is spent or none is wanted, each round where the atlas is worst by then."""
    points: list[Wanted] = []
    spent = 0
    while spent < options.budget:
        before = options.model_copy(update={"budget": spent})
        ds = run.derive("atlas", **before.part(PlaneOptions))
        more = wanted(_plane(run, before), ds, ds["node_region"].values, options.budget - spent)
        if not more:
            break
        points += more
        spent += sum(one.n_starts for one in more)
    names = axis_name(options.parameter), axis_name(options.second)
    places = [{**dict(zip(names, one.values, strict=True)), **options.at} for one in points]
    found = run.at_points(places, [one.n_starts for one in points]) if points else []
    n = sum(one.n_starts for one in points)
    run.echo(f"atlas: {len(points)} further points with {n} cells")
    ds = further_dataset(points, [one.derive("identified") for one in found], run.model.state_names)
    return ds.assign_attrs(first_parameter=names[0], second_parameter=names[1])


# ---- ends of orbits ----------------------------------------------------------------------------


def ways(run: OpenRun, options: PlaneOptions) -> list[list[float]]:
    """List the orbits to follow: the row of each, the parameter along which (0 or 1), and up to which value."""
    plane = _plane(run, options)
    return [list(way) for way in _ways(plane, changes_of(plane, run.model.system))]


def _ways(plane: Plane, changes: Sequence[Change]) -> list[tuple[int, int, float]]:
    found = []
    for one in changes:
        axis = plane.axis_of(one.edge)
        if plane.kind[one.row] not in APERIODIC:
            found.append((one.row, axis, float(plane.values[one.there, axis])))
    return found


def orbit_ends(run: OpenRun, options: PlaneOptions, wanted: Sequence[Sequence[float]]) -> xr.Dataset:
    """Follow orbits that a neighbouring point lacks towards that point."""
    plane = _plane(run, options)
    return ends_dataset(plane, wanted, _followed(run, plane, wanted), run.model.state_names)


def _followed(run: OpenRun, plane: Plane, wanted: Sequence[Sequence[float]]) -> list[End]:
    """Follow orbits from their points: the row of each, the parameter along which, and up to which value."""
    base, starts = parameters_of(run.cube()), []
    ends = [End(UNDECIDED, why="Newton's method found no orbit there")] * len(wanted)
    for k, (row, axis, target) in enumerate(wanted):
        start = start_of(plane, int(row), int(axis), base)
        if start is not None:
            starts.append((k, start, float(target)))
    followed = follow_all([(start, target) for _, start, target in starts])
    for (k, _, _), end in zip(starts, followed, strict=True):
        ends[k] = end
    return ends


def windows(run: OpenRun, options: SetEndOptions) -> list[list[float]]:
    """List the sets to name: the row of each, the parameter along which (0 or 1), and the value of the neighbour."""
    plane = _plane(run, options)
    changes = changes_of(plane, run.model.system)
    return [
        [changes[k].row, plane.axis_of(changes[k].edge), plane.values[changes[k].there, plane.axis_of(changes[k].edge)]]
        for k in chosen(set_lines(plane, changes), options.windows)
    ]


def set_ends(run: OpenRun, options: SetEndOptions, wanted: Sequence[Sequence[float]]) -> xr.Dataset:
    """Name ends of chaotic sets and tori between neighbouring points."""
    plane, base = _plane(run, options), parameters_of(run.cube())
    ends = [named(plane, int(row), int(axis), float(target), base) for row, axis, target in wanted]
    return ends_dataset(plane, wanted, ends, run.model.state_names)


# ---- the atlas ---------------------------------------------------------------------------------


def atlas(run: OpenRun, options: AtlasOptions) -> xr.Dataset:
    """Chart the plane of two parameters of a run, and hold its curves against its attractors.

    Returns
    -------
    Dataset
        The curves as of the analysis ``curves``, with what each does to attractors; ``line`` for ends that lie side by
        side but on no curve; ``change`` for each attractor that a neighbouring point lacks, with what explains it;
        ``region``, ``member`` (attractors of regions), ``border`` and ``ring``.
    """
    plane = _plane(run, options)
    changes = changes_of(plane, run.model.system)
    run.echo(f"atlas: {len(changes)} changes between {len(plane.edges)} pairs of neighbouring points")
    found = _verdicts(run, options, plane, changes)
    searched = _searched(run, options, plane)
    chart = _charted(run, options, plane, changes, found, _hidden_ends(run, plane, searched))
    tracks = [plane.scaled(np.array([c.family.values(p.u) for p in c.points])) for c in chart.curves]
    others = [others_unstable(curve) for curve in chart.curves]
    crossed = crossings(plane, tracks, [one == 0 for one in others])
    _look_again(run, plane, changes, found, chart, crossed)
    seen = [one for one in found if one.is_seen]
    run.echo(f"atlas: {sum(one.is_explained for one in seen)} of {len(seen)} changes explained")
    lines = _lines(plane, changes, found)
    curves = curves_dataset(chart.curves, *plane.names, run.model)
    told = effects_of(plane, changes, found, chart.curves, crossed, [one == 0 for one in others])
    variables = {**of_curves(curves, others, told), **of_lines(lines), **of_changes(plane, changes, found)}
    variables |= of_searched(plane, searched)
    same = [(change.row, one.row) for change, one in zip(changes, found, strict=True) if one.row >= 0]
    same += [(row, heir) for (row, _), heir in continued(plane).items()]
    pairs = np.array(same, int).reshape(-1, 2)
    variables |= variables_of_regions(plane, tracks, [one == 0 for one in others], lines, pairs)
    return curves.assign(variables)


def _searched(run: OpenRun, options: AtlasOptions, plane: Plane) -> list[Searched]:
    """Search all orbits at some points of the grid."""
    cube, base = run.cube(), parameters_of(run.cube())
    cube = cube.sel(options.at) if options.at else cube
    nodes = nodes_for(plane, options.isolas)
    return [searched_at(plane, cube, node, base, options.curve_period) for node in track(nodes, "searching orbits")]


def _hidden_ends(run: OpenRun, plane: Plane, searched: Sequence[Searched]) -> list[Located]:
    """Return the bifurcations at which orbits end on which no cell ends."""
    found = []
    for number, (one, axis, end) in enumerate(followed_from(plane, searched, parameters_of(run.cube()))):
        if end.what in KINDS and end.state is not None:
            place = plane.values[one.node].copy()
            place[axis] = end.value
            near = end.error / plane.size[axis]
            family = _family(run, plane, end.period)
            found.append(Located(family, end.what, -2 - number, end.state, place, near if near > 1e-6 else 0.0))
    return found


def _verdicts(run: OpenRun, options: AtlasOptions, plane: Plane, changes: Sequence[Change]) -> list[Verdict]:
    """Say of each change what explains it: of an orbit where it ends, of another set what names its end."""
    system, count = run.model.system, iter(range(len(changes)))
    numbers = [-1 if plane.kind[one.row] in APERIODIC else next(count) for one in changes]
    found = verdicts(plane, changes, numbers, run.derive("orbit_ends", **options.part(PlaneOptions)), system)
    lines = set_lines(plane, changes)
    if tested := chosen(lines, options.windows):
        ends = run.derive("set_ends", **options.part(SetEndOptions))
        own = verdicts(plane, [changes[k] for k in tested], range(len(tested)), ends, system)
        for k, one in zip(tested, own, strict=True):
            found[k] = one
    carried(lines, found, tested)
    return found


def _family(run: OpenRun, plane: Plane, period: int) -> Family:
    """Return the family of orbits of a period, or of equilibria, with both parameters of the plane free."""
    frequency, packed = at_node(plane, 0, parameters_of(run.cube()))
    scales = (float(plane.size[0]), float(plane.size[1]))
    return Family(run.model.system, period, frequency, packed, plane.names, scales)


def _located(
    run: OpenRun, plane: Plane, changes: Sequence[Change], found: Sequence[Verdict], own: Sequence[int]
) -> list[Located]:
    """Return the bifurcations that explain some changes."""
    families = {period: _family(run, plane, period) for period in {0, *(found[k].period for k in own)}}
    return [
        Located(
            families[0 if one.what in (HOMOCLINIC, SNIC) else one.period],
            one.what,
            int(plane.attractor[change.row]),
            np.asarray(one.state),
            one.place,
            one.error if one.error > 1e-6 else 0.0,
        )
        for one, change in ((found[k], changes[k]) for k in own)
    ]


def _charted(
    run: OpenRun,
    options: AtlasOptions,
    plane: Plane,
    changes: Sequence[Change],
    found: Sequence[Verdict],
    hidden: Sequence[Located],
) -> Chart:
    """Continue the located bifurcations, and give each change the curve on which it lies."""
    own = [
        k
        for k, one in enumerate(found)
        if one.what in (*KINDS, HOMOCLINIC, SNIC) and one.state is not None and one.period <= options.curve_period
    ]
    located = [*_located(run, plane, changes, found, own), *hidden]
    margin = MARGIN * plane.size
    low, high = plane.low - margin, plane.low + plane.size + margin
    for axis, name in enumerate(plane.names):
        if name == FREQUENCY:
            low[axis] = max(low[axis], 0.5 * plane.low[axis])
    bounds = (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
    chart = charted(located, bounds, options.curve_period)
    for i, (k, curve) in enumerate(zip(own, chart.curve_of.tolist(), strict=False)):
        found[k].curve = curve
        if curve < 0:
            found[k].why = found[k].why or chart.lost.get(i, "")
    _agree(plane, changes, found)
    on_edge = {(changes[k].edge, found[k].what): found[k] for k in own if found[k].curve >= 0}
    for one, change in zip(found, changes, strict=True):  # a torus begins at the bifurcation that ends an orbit
        if one.curve < 0 and one.state is None and (other := on_edge.get((change.edge, one.what))) is not None:
            one.curve, one.place, one.error = other.curve, other.place, other.error
    return chart


def _look_again(
    run: OpenRun, plane: Plane, changes: list[Change], found: list[Verdict], chart: Chart, crossed: Crossings
) -> None:
    """Add changes that move too little to be seen as jumps, as near a cusp: where the stable part of a curve passes
    between two points without a change, their orbits are followed as well; in place.
    """
    known = {(change.edge, one.curve) for change, one in zip(changes, found, strict=True)}
    ways = {(change.edge, change.row) for change in changes}
    asked = [
        change
        for curve, edge in sorted(set(zip(crossed.curve, crossed.edge, strict=True)) - {(c, e) for e, c in known})
        for change in pairs_on(plane, edge, chart.curves[curve].family.period)
        if (edge, change.row) not in ways and not plane.is_parted[edge]
    ]
    asked = list(dict.fromkeys(asked))
    wanted = [list(way) for way in _ways(plane, asked)]
    ends = ends_dataset(plane, wanted, _followed(run, plane, wanted), run.model.state_names)
    more = verdicts(plane, asked, range(len(asked)), ends, run.model.system)
    seen = [k for k, one in enumerate(more) if one.what in KINDS]
    for k, one in zip(seen, _located(run, plane, asked, more, seen), strict=True):
        more[k].curve = chart.holding(one)
        changes.append(asked[k])
        found.append(more[k])


def _agree(plane: Plane, changes: Sequence[Change], found: Sequence[Verdict]) -> None:
    """Give the ends at one crossing of a curve with an edge the place that is known best; in place.

    A curve may cross an edge twice, as the two folds beside a cusp do: places agree within their errors.
    """
    rounding = 1e-9
    crossed: dict[tuple[int, int], list[Verdict]] = {}
    for change, one in zip(changes, found, strict=True):
        if one.curve >= 0:
            crossed.setdefault((change.edge, one.curve), []).append(one)
    for own in crossed.values():
        best: list[Verdict] = []
        for one in sorted(own, key=lambda verdict: verdict.error):
            away = [np.linalg.norm(plane.scaled(one.place) - plane.scaled(other.place)) for other in best]
            if away and min(away) <= 2.0 * one.error + rounding:
                known = best[int(np.argmin(away))]
                one.place, one.error = known.place, known.error
            else:
                best.append(one)


def _lines(plane: Plane, changes: Sequence[Change], found: Sequence[Verdict]) -> list[Line]:
    """Join the changes that are explained and lie on no curve, and give each its line."""
    own = [k for k, v in enumerate(found) if v.curve < 0 and v.is_seen and v.what not in (UNDECIDED, LIVES_ON)]
    items: list[tuple[int, Key, Array]] = [
        (
            int(plane.parent[changes[k].edge]),
            (found[k].what, found[k].period, int(plane.kind[changes[k].row])),
            found[k].place,
        )
        for k in own
    ]
    lines = lines_through(plane, items)
    for number, line in enumerate(lines):
        for item in line.items:
            found[own[item]].line = number
    return lines
