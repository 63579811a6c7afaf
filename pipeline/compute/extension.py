"""Integrate the cells of a stored run further, for a new run that keeps more section points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from magpend_core import Status
from magpend_core.engine.observers import window_of
from magpend_core.extension import more_sections, orbit_periods
from pipeline.compute.integrate import watched_quantities
from pipeline.compute.noise import noisy_kept_on
from pipeline.layout.cells import Inputs
from pipeline.specification.parsing import Spec

Values = dict[str, np.ndarray]

SUMS = ("turns", "n_periods", "n_steps", "n_rejected")
"""Variables to which the extension is added."""
PER_SECTION = ("section", "extremes")
"""Variables with an entry for each kept section, NaN in cells that failed."""


def obstacle(old: Spec, new: Spec) -> str:
    """Return the reason why stored cells cannot be integrated further for a new run; an empty text if they can."""
    had, wanted = old.integration.n_keep, new.integration.n_keep
    if had == wanted:
        return ""
    line = f"integration.n_keep: {had} in the directory, {wanted} now; "
    if wanted < had:
        return f"{line}fewer sections are not taken out of more"
    if new.continuation is not None:
        return f"{line}each point of a walk begins where all kept sections of the one before end"
    if new.unsteady or new.section is not None:
        what = "with a section by crossing"
        if new.unsteady:
            what = "whose parameters move" if new.drift else "under a recorded drive"
        return f"{line}cells {what} do not go on"
    if new.noise is None and not new.integration.stop_when_closed and wanted < _judged(new):
        return f"{line}what closes is judged by the last {_judged(new)} sections: keep as many"
    return ""


def _judged(spec: Spec) -> int:
    """Return the number of last section points from which a run decides whether an orbit has closed."""
    n_periods = spec.integration.n_transient + spec.integration.n_keep
    return min(n_periods, window_of(spec.integration.max_orbit_period))


def kept_on(spec: Spec, inputs: Inputs, stored: Mapping[str, np.ndarray], n_old: int) -> tuple[Any, Values]:
    """Integrate cells of an earlier run further, until they have as many section points as the new run keeps.

    A cell is left out if its outcome could differ from that of a longer run: if the moment at which its orbit
    closed is not known, or if it fails later.

    Parameters
    ----------
    spec
        Specification of the run.
    inputs
        Inputs of the cells, as branches of one point.
    stored
        Variables of the cells, with leading dims (branch, point).
    n_old
        Number of sections that the cells have.

    Returns
    -------
    is_exact : ndarray of bool, (branch,)
        Mask of the cells that have the values of a longer run.
    values : dict
        Variables of these cells.
    """
    if spec.noise is not None:
        return noisy_kept_on(spec, inputs, stored, n_old)
    was_kept = np.isin(stored["status"][:, 0], (Status.PERIODIC, Status.BOUNDED))
    closed = was_kept & (stored["n_periods"][:, 0] < spec.integration.n_transient + n_old)
    is_exact = ~was_kept | closed
    if spec.integration.n_keep >= _judged(spec):
        # where a run stops at closed orbits, one of these may have closed in the very last period before
        unsure = spec.integration.stop_when_closed & (stored["status"][:, 0] == Status.PERIODIC)
        is_exact |= ~unsure
    go = np.flatnonzero(was_kept & is_exact)
    more = _more(spec, inputs.take(go), stored["section"][go, 0, -1], stored["step_size"][go, 0], n_old)
    failed = go[more["status"][:, 0] != Status.BOUNDED]
    values = {name: _longer(name, array, more, go, spec.integration.n_keep) for name, array in stored.items()}
    judged = np.flatnonzero(was_kept & is_exact & ~closed)
    periods = (
        orbit_periods(
            values["section"][judged, 0, -_judged(spec) :],
            system=spec.model.system,
            closure_tolerance=spec.integration.closure_tolerance,
            max_orbit_period=spec.integration.max_orbit_period,
        )
        if len(judged)
        else np.zeros(0, np.int16)
    )
    values["orbit_period"][judged, 0] = periods
    values["status"][judged, 0] = np.where(periods > 0, Status.PERIODIC, Status.BOUNDED)
    is_exact[failed] = False
    return is_exact, {name: array[is_exact] for name, array in values.items()}


def _more(spec: Spec, inputs: Inputs, last: np.ndarray, step_size: np.ndarray, n_old: int) -> Values:
    """Integrate cells from their stored last states over the missing periods; return the variables of these periods."""
    integration = spec.integration
    cells = more_sections(
        inputs.parameters,
        inputs.frequency_hz,
        last,
        step_size,
        n_more=integration.n_keep - n_old,
        rtol=integration.rtol,
        atol=integration.atol,
        max_steps_per_period=integration.max_steps_per_period,
        system=replace(spec.model.system, method=integration.method),
        quantities=watched_quantities(spec),
    )
    names = ("status", "step_size", *SUMS, *PER_SECTION)
    return {name: np.asarray(getattr(cells, name)) for name in names if getattr(cells, name) is not None}


def _longer(name: str, old: np.ndarray, more: Mapping[str, np.ndarray], go: np.ndarray, n: int) -> np.ndarray:
    if name in PER_SECTION:
        whole = np.full((*old.shape[:2], n, *old.shape[3:]), np.nan)
        whole[go] = np.concatenate([old[go], more[name]], axis=2)
        return whole
    new = old.copy()
    if name in SUMS:
        new[go] += more[name]
    elif name == "step_size":
        new[go] = more[name]
    return new
