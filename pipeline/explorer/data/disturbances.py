"""Read the stored critical shocks and edge states of a parameter point, which the page draws in the plane of states."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.ragged import isel
from pipeline.analysis.resilience.table import end_of
from pipeline.analysis.tabular import sets_of
from pipeline.explorer.data.clicked_orbit import finite
from pipeline.explorer.data.explored import ExploredRun
from pipeline.explorer.data.overlays import MOST_SECTION, SAME_VALUE
from pipeline.explorer.data.view import can_have
from pipeline.layout.vocabulary import ATTRACTS, KINDS, letter
from pipeline.store.run import RunDirectory


def disturbances(run: RunDirectory, at: Mapping[str, int]) -> dict[str, Any]:
    """Return the critical shocks of the attractors at a parameter point, and the edge states between them.

    Parameters
    ----------
    run
        An opened run.
    at
        Index on every swept axis.

    Returns
    -------
    dict
        ``shocks``: for each attractor ``smallest`` (of the states that the analysis shocked, at any phase) and
        ``shortest`` (of all states, at the section); ``edges``; ``notes``: how to get what is not stored for
        this point. States are lists in the order of the model's.

    Raises
    ------
    ExplorerError
        If an axis or an index is not there.
    """
    explored = ExploredRun.of(run)
    place = explored.place(at)
    shocks = next((list(_shocks(explored, one)) for one in _here(explored, "resilience", place)), None)
    edges = [edge for one in _here(explored, "edge", place) for edge in _edges(one)]
    notes = []
    if run_has_basins(explored):
        if shocks is None:
            notes.append("critical shocks are not computed here: magpend analyse resilience DIR")
        if not edges:
            point = "".join(f" --at {name}=VALUE" for name in place)
            notes.append(f"edge states are not computed here: magpend analyse edge DIR --between A B{point}")
    return {"shocks": shocks or [], "edges": edges, "notes": notes}


def run_has_basins(run: ExploredRun) -> bool:
    """Return whether shocks of a run's attractors and edge states can be computed; they need independent starts."""
    return run.remembered("has basins", lambda: can_have(run, "resilience"))


def _here(run: ExploredRun, name: str, place: Mapping[str, int]) -> Iterator[xr.Dataset]:
    """Yield the stored results of an analysis at a parameter point that name the attractors as the page does."""
    for one in run.kept_each(name):
        index = _index(run, one, place)
        if index is not None:
            yield isel(one, index).load()


def _index(run: ExploredRun, found: xr.Dataset, place: Mapping[str, int]) -> dict[str, int] | None:
    """Return the index of a parameter point in a result that may have some points only; None if it lacks it."""
    index = {}
    for name, i in place.items():
        if name not in found.coords:
            return None
        value = float(run.axis(name).values[i])
        near = [math.isclose(v, value, rel_tol=SAME_VALUE, abs_tol=1e-300) for v in np.atleast_1d(found[name].values)]
        if True not in near:
            return None
        if name in found.dims:
            index[name] = near.index(True)
    return index


def _shocks(run: ExploredRun, found: xr.Dataset) -> Iterator[dict[str, Any]]:
    """Yield the critical shocks of each attractor."""
    largest = float(found.attrs["resilience_largest"])
    for _, one in sets_of(found, found["stability"].values == ATTRACTS):
        number = int(one["attractor"])
        yield {
            "attractor": number,
            "letter": letter(number),
            "largest": largest,
            "states": [name.strip() for name in str(found.attrs["resilience_states"]).split(",")],
            "smallest": _shock(run, one, "shock"),
            "shortest": _shock(run, one, "distance"),
        }


def _shock(run: ExploredRun, one: xr.Dataset, name: str) -> dict[str, Any] | None:
    """Return a critical shock; None if no shock that was tried leads away."""
    jump, before = one[name].values, one[f"{name}_from"].values
    if not (np.isfinite(jump).all() and np.isfinite(before).all()):
        return None
    phase, to = float(one[f"{name}_phase"]), int(one[f"{name}_to"])
    return {
        "low": finite(one[f"{name}_low"]),
        "high": finite(one[f"{name}_high"]),
        "phase": phase,
        # the motion of a flow from a state does not depend on the time
        "startable": phase == 0.0 or run.model.autonomous,
        "from": before.tolist(),
        "jump": jump.tolist(),
        "to": to,
        "leads_to": end_of(to),
        "n_undecided": int(one[f"{name}_n_undecided"]),
    }


def _edges(found: xr.Dataset) -> Iterator[dict[str, Any]]:
    """Yield the edge states between two attractors."""
    for i in range(found.sizes["edge"]):
        one = found.isel(edge=i)
        yield {
            "between": str(found.attrs["between_letters"]).split(),
            "kind": KINDS[int(one["kind"])].replace("_", " "),
            "period": int(one["orbit_period"]) or None,
            "n_pairs": int(one["n_pairs"]),
            "section": one["section"].values[: min(int(one["n_points"]), MOST_SECTION)].tolist(),
            "multipliers": _complex(one, "multiplier"),
            "eigenvalues": _complex(one, "eigenvalue"),
        }


def _complex(one: xr.Dataset, name: str) -> list[list[float]] | None:
    parts = np.stack([one[f"{name}_real"].values, one[f"{name}_imag"].values], axis=-1)
    return parts.tolist() if np.isfinite(parts).all() else None
