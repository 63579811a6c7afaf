"""Say in sentences what an atlas contains."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
import xarray as xr

from pipeline.analysis.atlas.table import MOST, audit_of, kind_text, listed_kinds, open_changes, told_change
from pipeline.analysis.branches.kinds import CURVE_KINDS, NAMES
from pipeline.layout.conventions import shown_unit
from pipeline.layout.vocabulary import letter
from pipeline.results.tabular import counted, plain, words_of

LEAST_AREA = 0.002
"""Share of the plane below which the attractors of a region are not described, and have no colour of their own."""


def sentences(ds: xr.Dataset) -> list[str]:
    """Return paragraphs on an atlas: its larger regions with their attractors, what parts them, the audit, and regions
    in which attractors may be missing.
    """
    larger = np.flatnonzero(ds["area"].values >= LEAST_AREA).tolist()[:MOST]
    return [_plane(ds), *_regions(ds, larger), *_borders(ds, larger), *_audit(ds), *_silent(ds), *_thin(ds)]


def member_text(ds: xr.Dataset, row: int) -> str:
    """Return an attractor of a region, as a text: its letter, kind, period, and fraction with its 95 % interval."""
    one = ds.isel(member=row)
    period = int(one["member_period"])
    name = plain(words_of(ds["member_set"])[int(one["member_set"])]) + (f" of period {period}" if period else "")
    share, low, high = (float(one[f"member_share{end}"]) for end in ("", "_low", "_high"))
    return f"{letter(int(one['member_attractor']))}, {name}: {share:.3f} ({low:.3f} to {high:.3f})"


def members_of(ds: xr.Dataset, region: int) -> list[int]:
    """Return the rows of the attractors of a region, the largest share first."""
    rows = np.flatnonzero(ds["of_region"].values == region)
    found: list[int] = rows[np.argsort(-ds["member_share"].values[rows], kind="stable")].tolist()
    return found


def region_text(ds: xr.Dataset, region: int) -> str:
    """Return the size of a region, and how many of its points and cells are known."""
    n, cells = int(ds["region_points"][region]), int(ds["region_cells"][region])
    seen = f"{counted(n, 'parameter point')} and {counted(cells, 'cell')}" if n else "no parameter point"
    return f"Region {region} covers {100.0 * float(ds['area'][region]):.3g} % of the plane, with {seen}"


def _plane(ds: xr.Dataset) -> str:
    ranges = []
    for which in ("first", "second"):
        values, unit = ds[f"corner_{which}"].values, shown_unit(ds[f"corner_{which}"].attrs)
        to = f"{values.min():.6g} to {values.max():.6g}{'' if unit == '1' else ' ' + unit}"
        ranges.append(f"{ds.attrs[f'{which}_parameter']} ({to})")
    curves, lines = counted(ds.sizes["curve"], "curve"), counted(ds.sizes["line"], "line")
    found = f"{counted(ds.sizes['region'], 'region')}, {curves} of bifurcations and {lines} of other ends of attractors"
    return f"The plane of {' and '.join(ranges)} has {found}."


def _regions(ds: xr.Dataset, larger: list[int]) -> Iterator[str]:
    for region in larger:
        own = members_of(ds, region)
        listed = "; ".join(member_text(ds, row) for row in own[:MOST])
        more = f"; and {len(own) - MOST} more" if len(own) > MOST else ""
        met = f"{counted(len(own), 'attractor')} (fraction of these cells and its 95 % interval): {listed}{more}"
        yield f"{region_text(ds, region)}. Met there: {met if own else 'no attractor'}."
    if n := ds.sizes["region"] - len(larger):
        share = f"{100.0 * (1.0 - float(ds['area'].values[larger].sum())):.2g} % of the plane"
        yield f"{counted(n, 'smaller region')} ({share}) {'is' if n == 1 else 'are'} not described here."


def _borders(ds: xr.Dataset, larger: list[int]) -> Iterator[str]:
    """Say which curves and lines part the larger regions, the longest borders first."""
    parted: dict[tuple[int, ...], dict[str, float]] = defaultdict(dict)
    for sides, between, length in zip(
        ds["neighbour"].values.tolist(), ds["between"].values.tolist(), ds["border_length"].values.tolist(), strict=True
    ):
        if set(sides) <= set(larger):
            parted[tuple(sides)][border_text(ds, between)] = length
    pairs = sorted(parted, key=lambda pair: -sum(parted[pair].values()))
    told = [f"{a} and {b} by {', '.join(parted[a, b])}" for a, b in pairs[:MOST]]
    if told:
        more = f"; {len(pairs) - MOST} more pairs have shorter borders" if len(pairs) > MOST else ""
        yield f"What parts regions: {'; '.join(told)}{more}."


def border_text(ds: xr.Dataset, number: int) -> str:
    """Return the curve or the line that is a border between two regions, as a text; lines are numbered after curves."""
    n = ds.sizes["curve"]
    if number < n:
        period = int(ds["orbit_period"][number])
        kind = NAMES[CURVE_KINDS[int(ds["kind"][number])]]
        return f"curve {number} ({kind}, {f'period {period}' if period else 'equilibria'})"
    kind = words_of(ds["line_what"])[int(ds["line_what"][number - n])]
    return f"line {number - n} ({kind_text(kind)})"


def _audit(ds: xr.Dataset) -> Iterator[str]:
    n = audit_of(ds)
    if not n["seen"]:
        yield "No attractor differs between neighbouring parameter points."
        return
    listed = listed_kinds(ds)
    told = [f"{n['on_curves']} on curves and {n['on_lines']} on lines{f' ({listed})' if listed else ''}"]
    if n["not_found"]:
        told += [f"{n['not_found']} of orbits that are stable at both points, where no cell of one point finds them"]
    told += [f"{n['not_explained'] or 'none'} left without an explanation"]
    changes = f"{counted(n['seen'], 'change')} of attractors"
    yield f"The cells show {changes} between neighbouring parameter points: {'; '.join(told)}."
    left = open_changes(ds)
    yield from (f"Not explained: {told_change(ds, k)}. {_sentence(str(ds['why'].values[k]))}" for k in left[:MOST])
    if len(left) > MOST:
        yield f"{counted(len(left) - MOST, 'more change')} without an explanation: see the table of the analysis."


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _silent(ds: xr.Dataset) -> Iterator[str]:
    """Say which curves change no attractor, and why."""
    curves: dict[str, list[int]] = defaultdict(list)
    for k in np.flatnonzero(ds["n_effects"].values == 0).tolist():
        curves[str(ds["effect"].values[k])].append(k)
    if curves:
        told = "; ".join(f"{_numbers('curve', own)}, {why}" for why, own in list(curves.items())[:MOST])
        yield f"{sum(map(len, curves.values()))} of {counted(ds.sizes['curve'], 'curve')} change no attractor: {told}."


def _numbers(noun: str, own: list[int]) -> str:
    listed = ", ".join(map(str, own[:MOST])) + (f" and {len(own) - MOST} more" if len(own) > MOST else "")
    return f"{noun}{'' if len(own) == 1 else 's'} {listed}"


def _thin(ds: xr.Dataset) -> Iterator[str]:
    thin = np.flatnonzero(ds["is_thin"].values == 1).tolist()
    if thin:
        where = "any region" if len(thin) == ds.sizes["region"] else _numbers("region", thin)
        yield f"Fewer than 299 cells are known in {where}: an attractor with a basin of 1 % may be missing there."
