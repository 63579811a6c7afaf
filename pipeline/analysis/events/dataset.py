"""Write the events of attractors, and the stretches between them, as a Dataset."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.branches.dataset import CRITICALITIES
from pipeline.analysis.branches.kinds import BRANCHING
from pipeline.analysis.events.crises import Crisis
from pipeline.analysis.events.graph import at_ends
from pipeline.analysis.events.kinds import EVENTS, LIVES_ON, UNDECIDED
from pipeline.analysis.events.lines import Fate
from pipeline.analysis.events.one_event import is_own, same_as
from pipeline.analysis.events.scene import Born, Event, Scene, Stretch
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import KINDS as SETS
from pipeline.results.outcomes import DIVERGED

Columns = dict[str, Sequence[object]]
"""Values of the columns of events, by name."""


def dataset_of(scene: Scene, stretches: Sequence[Stretch], named: Sequence[Event]) -> xr.Dataset:
    """Return the events and stretches of a scene as the Dataset of the analysis."""
    codes = {"set": SETS, "what": list(EVENTS), "criticality": ["unknown", *CRITICALITIES[1:]]}
    named = sorted(named, key=lambda one: (one.stretch.attractor, one.stretch.places[one.rises]))
    located, along, n = scene.located, scene.along, len(scene.along)
    beyond = [one.beyond for one in named]
    bifurcations = np.array([one.fate.bifurcation for one in named], int)
    own = [is_own(located, one.fate) for one in named]
    degrees = [
        int(located["criticality"].values[one.fate.bifurcation])
        if one.fate.bifurcation >= 0 and one.what != BRANCHING
        else 0
        for one in named
    ]
    columns: Columns = {
        "attractor": [one.stretch.attractor for one in named],
        "set": [one.stretch.kind for one in named],
        "period": [one.stretch.period for one in named],
        "period_after": [one.after.period if one.after else -1 for one in named],
        "rises": [int(one.rises) for one in named],
        "what": [codes["what"].index(one.what) for one in named],
        "criticality": degrees,
        "value": [_value(one) for one in named],
        "value_error": [one.error for one in named],
        "seen": [along[one.stretch.places[one.rises]] for one in named],
        "beyond": [along[b] if 0 <= b < n else np.nan for b in beyond],
        "bifurcation": bifurcations.tolist(),
        "branch": [one.fate.branch for one in named],
        "other_branch": [_other_branch(located, one.fate) for one in named],
        "is_own": own,
        "n_cells": [one.n_cells for one in named],
        "same_as": same_as(scene, named),
        "evidence": [one.fate.why for one in named],
    }
    variables: dict[str, object] = {
        name: ("event", np.array(values), code_flags(codes[name]) if name in codes else {})
        for name, values in (columns | _columns_of_sets(named)).items()
    }
    to = [list(one.to) for one in named], [list(one.to.values()) for one in named]
    doublings = [one.born.doublings if one.born else () for one in named]
    variables["to_attractor"] = (("event", "outcome"), _padded(to[0], -1).astype(int))
    variables["to_cells"] = (("event", "outcome"), _padded(to[1], 0).astype(int))
    ends = [_stretches_beyond(stretches, one, b) for one, b in zip(named, beyond, strict=True)]
    variables["to_stretch"] = (("event", "outcome"), _padded(ends, -1).astype(int))
    after = [stretches.index(one.after) if one.after else -1 for one in named]
    variables["stretch_of"] = ("event", np.array([stretches.index(one.stretch) for one in named], int))
    variables["stretch_after"] = ("event", np.array(after, int))
    variables["doublings"] = (("event", "doubling"), _padded(doublings, np.nan))
    kept = {name: located.attrs[name] for name in ("parameter", "parameter_units", "model") if name in located.attrs}
    return xr.Dataset(variables | _bars(scene, stretches, named), attrs=kept)


def _stretches_beyond(stretches: Sequence[Stretch], event: Event, beyond: int) -> list[int]:
    """Return the stretches on which the cells of an event go on; -1 none, -2 they diverge."""
    there = {one.attractor: k for k, one in enumerate(stretches) if one.places[0] <= beyond <= one.places[1]}
    return [DIVERGED if i == DIVERGED else there.get(i, -1) for i in event.to]


def _columns_of_sets(named: Sequence[Event]) -> Columns:
    """Return the columns of ends of chaotic sets and tori."""
    born = [one.born or Born("", "") for one in named]
    crises = [one if isinstance(one, Crisis) else Crisis("", "") for one in born]
    return {
        "ratio": [one.ratio for one in born],
        "exponent": [one.exponent for one in born],
        "exponent_error": [one.exponent_error for one in born],
        "rotation": [one.rotation for one in born],
        "met_period": [one.period for one in crises],
        "twin": [one.twin for one in crises],
        "lives_beyond": [int(one.lives_beyond) for one in crises],
    }


def _padded(rows: Sequence[Sequence[float]], fill: float) -> np.ndarray:
    """Stack rows of different lengths to an array."""
    found = np.full((len(rows), max([1, *map(len, rows)])), fill)
    for one, row in zip(found, rows, strict=True):
        one[: len(row)] = row
    return found


def _value(one: Event) -> float:
    return np.nan if one.what in (UNDECIDED, LIVES_ON) else one.fate.value


def _bars(scene: Scene, stretches: Sequence[Stretch], named: Sequence[Event]) -> dict[str, object]:
    """Return the range of each stretch, up to its events where they are decided."""
    ends = {(one.stretch, one.rises): _value(one) for one in named}
    ends |= {(one.after, not one.rises): _value(one) for one in named if one.after}

    def end(one: Stretch, rises: bool) -> float:
        found = ends[one, rises]
        return float(scene.along[one.places[rises]]) if np.isnan(found) else found

    columns: Columns = {
        "attractor": [one.attractor for one in stretches],
        "set": [one.kind for one in stretches],
        "period": [one.period for one in stretches],
        "low": [end(one, False) for one in stretches],
        "high": [end(one, True) for one in stretches],
    }
    bars: dict[str, object] = {
        f"stretch_{name}": ("stretch", np.array(values), code_flags(SETS) if name == "set" else {})
        for name, values in columns.items()
    }
    places = [[(place, scene.ids_of(one.attractor, place)) for place in one.places] for one in stretches]
    return bars | at_ends(scene.attractors, scene.axis, scene.order, [one.rows for one in stretches], places)


def _other_branch(ds: xr.Dataset, fate: Fate) -> int:
    if fate.bifurcation < 0:
        return -1
    both = (int(ds[name].values[fate.bifurcation]) for name in ("of_branch", "to_branch"))
    return next((one for one in both if one != fate.branch), -1)
