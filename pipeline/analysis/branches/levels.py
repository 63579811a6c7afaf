"""Choose branches and bifurcations by the values of parameters that stay fixed along them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from pipeline.analysis.branches.analysis import fixed_of
from pipeline.layout.vocabulary import axis_name, parameter_name
from pipeline.results.tolerances import SAME_LEVEL
from pipeline.specification.problems import SpecError, unknown_name


def at_levels(ds: xr.Dataset, at: Mapping[str, float]) -> xr.Dataset:
    """Return the branches at some values of their fixed parameters, with their bifurcations and jumps.

    Parameters
    ----------
    ds
        From the analysis ``branches``, or one that builds on it.
    at
        Value by axis, each on its axis. An axis of one value selects nothing.

    Raises
    ------
    SpecError
        If an axis is the followed parameter, or no branch has the value.
    """
    levels = [fixed_of(ds, i) for i in range(ds.sizes["branch"])]
    kept = _kept(levels, at, str(ds.attrs["parameter"]), "branch")
    place = np.full(ds.sizes["branch"] + 1, -1)  # the last is that of -1, no branch
    place[kept] = np.arange(len(kept))
    events = np.flatnonzero(place[ds["of_branch"].values] >= 0)
    event_place = np.full(ds.sizes["bifurcation"] + 1, -1)
    event_place[events] = np.arange(len(events))
    part = ds.isel(branch=kept, bifurcation=events)
    moved = {n: place for n in ("of_branch", "to_branch")} | {"origin": event_place}
    moved |= {n: event_place for n in ("image",) if n in ds}
    if "jump" in ds.dims:
        part = part.isel(jump=np.flatnonzero(event_place[ds["jump_bifurcation"].values] >= 0))
        moved["jump_bifurcation"] = event_place
    found = {n: (part[n].dims, to[part[n].values].astype(part[n].dtype), part[n].attrs) for n, to in moved.items()}
    return part.assign(found)


def levels_of_bifurcations(ds: xr.Dataset) -> list[dict[str, float]]:
    """Return for each bifurcation of the analysis ``sensitivities`` the parameters that differ among them, by name."""
    values = ds["parameter_value"].values
    low, high = values.min(axis=0, initial=np.inf), values.max(axis=0, initial=-np.inf)
    differ = np.flatnonzero(high - low > SAME_LEVEL * np.maximum(np.abs(low), np.abs(high)))
    names = [parameter_name(str(name)) for name in ds["parameter"].values]
    return [{names[i]: float(one[i]) for i in differ} for one in values]


def bifurcations_at(ds: xr.Dataset, at: Mapping[str, float]) -> xr.Dataset:
    """Return the bifurcations of the analysis ``sensitivities`` at some values of their parameters; see `at_levels`."""
    return ds.isel(bifurcation=_kept(levels_of_bifurcations(ds), at, str(ds.attrs["parameter"]), "bifurcation"))


def refuse_at(at: Mapping[str, float], figure: str, why: str) -> None:
    """Raise SpecError if values of axes are given for a figure that shows all of them."""
    if at:
        name, value = next(iter(at.items()))
        raise SpecError(f"at {name} = {value:.10g}: {figure} takes no values of axes; {why}.")


def _kept(levels: Sequence[Mapping[str, float]], at: Mapping[str, float], along: str, what: str) -> list[int]:
    """Return the indices of the levels that have the given values; those that do not name a parameter have it."""
    kept = list(range(len(levels)))
    for axis, value in at.items():
        name = parameter_name(axis)
        if axis_name(name) == along:
            others = sorted({n for level in levels for n in level})
            raise SpecError(unknown_name("axis that stays fixed", name, others) + f" {name} is the axis of the figure.")
        own = {level[name] for level in levels if name in level}
        near = {v for v in own if abs(v - value) <= SAME_LEVEL * max(abs(v), abs(value))}
        if own and not near:
            there = ", ".join(f"{v:.10g}" for v in sorted(own))
            raise SpecError(f"at {name} = {value:.10g}: there is no {what}; there are some at {name} = {there}.")
        kept = [i for i in kept if name not in levels[i] or levels[i][name] in near]
    return kept
