"""Decide the outcome of each cell of a run: an attractor, divergence, or no outcome.

Shares are fractions of all cells. Cells that end on no attractor are counted by name: by the stability of their set,
or by the way they failed. Only this module makes that decision.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from magpend_core.troubleshooting import see
from pipeline.layout import vocabulary
from pipeline.layout.vocabulary import ATTRACTS, NEUTRAL, NOT_SETTLED, TRANSIENT, UNSTABLE, split_dims
from pipeline.layout.vocabulary import DIVERGES as DIVERGED_LATER
from pipeline.results.intervals import binomial_interval
from pipeline.results.ragged import is_ragged, rows_at

DIVERGED = -2
"""Label of cells that diverged, which is an outcome like an attractor. The label -1 means no outcome."""

_ON_SET = {
    UNSTABLE: "on an unstable orbit or equilibrium",
    TRANSIENT: "on a transient set",
    NOT_SETTLED: "not settled",
    NEUTRAL: "on a neutral set",
}

_BY_STATUS = {
    vocabulary.PENDING: "pending",
    vocabulary.STEP_LIMIT: "step limit",
    vocabulary.STEP_UNDERFLOW: "step underflow",
    vocabulary.UNREACHED: "unreached",
    vocabulary.NO_RETURN: "no return",
    vocabulary.CHATTER: "chatter",
}


def outcomes(ids: xr.Dataset) -> xr.DataArray:
    """Return the outcome of each cell: the id of its attractor, -2 (`DIVERGED`), or -1 if it reaches no attractor.

    Parameters
    ----------
    ids
        Result of `identify` or `match`.
    """
    label = np.where(stability_of_cells(ids) == ATTRACTS, _cells(ids, "attractor_id"), -1)
    gone = (_cells(ids, "status") == vocabulary.DIVERGED) | (_cells(ids, "decision") == DIVERGED_LATER)
    label[gone] = DIVERGED
    return ids["attractor_id"].transpose(*_dims(ids)).copy(data=label).transpose(*ids["attractor_id"].dims)


def stability_of_cells(ids: xr.Dataset) -> np.ndarray:
    """Return the stability code of the set on which each cell ends (0: none), with the parameter dims first."""
    cells = _cells(ids, "attractor_id")
    if not is_ragged(ids):
        stability = ids["stability"].transpose(*split_dims(ids["attractor_id"])[0], "attractor").values
        ended = np.concatenate([stability, np.zeros((*stability.shape[:-1], 1), stability.dtype)], axis=-1)
        flat = np.take_along_axis(ended, cells.reshape(*stability.shape[:-1], -1) % ended.shape[-1], axis=-1)
        return np.asarray(flat.reshape(cells.shape))
    number, stability = ids["attractor"].values, ids["stability"].values
    table = np.zeros(int(number.max(initial=-1)) + 2, np.int8)  # by id; the last entry is of cells without one
    found = np.zeros(cells.shape, np.int8)
    for index, own in rows_at(ids).items():
        here = slice(own.start, own.stop)
        table[number[here]] = stability[here]
        found[index] = table[cells[index]]
        table[number[here]] = 0
    return found


def other_cells(ids: xr.Dataset) -> Mapping[str, np.ndarray]:
    """Group the cells that end on no attractor by the reason; return a mask for each reason.

    Returns
    -------
    dict of ndarray of bool
        Masks by name, on the parameter dims and then the start dims. Each of these cells is in exactly one.
    """
    label = outcomes(ids).transpose(*_dims(ids)).values
    status, stability = _cells(ids, "status"), stability_of_cells(ids)
    left = label == -1
    found = {"diverged": label == DIVERGED}
    for code, name in _ON_SET.items():
        found[name] = left & (stability == code)
    left &= stability == 0
    found["growing"] = left & (_cells(ids, "decision") == vocabulary.GROWS)
    left &= ~found["growing"]
    for code, name in _BY_STATUS.items():
        found[name] = left & (status == code)
        left &= status != code
    found["not settled"] = found["not settled"] | left
    return {name: which for name, which in found.items() if which.any()}


def shares_of_others(ids: xr.Dataset) -> dict[str, np.ndarray]:
    """Return by reason the fraction of the cells of each parameter point that end on no attractor, in the order of the
    points.
    """
    n_points = int(np.prod([ids.sizes[d] for d in split_dims(ids["attractor_id"])[0]]))
    return {name: which.reshape(n_points, -1).mean(axis=1) for name, which in other_cells(ids).items()}


def share_interval(count: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the 95 % Wilson interval of basin fractions from cell counts; NaN where the fraction is 0.

    The analysis of basins has intervals at any level, see `pipeline.analysis.basins.numbers.basin_rows`.

    Parameters
    ----------
    count, share
        `n_cells` and `share` of sets, arrays of one shape.
    """
    shown = share > 0.0
    total = np.where(shown, np.rint(count / np.where(shown, share, 1.0)), 1.0)
    low, high = binomial_interval(np.where(shown, count, 0.0), total)
    return np.where(shown, low, np.nan), np.where(shown, high, np.nan)


def _dims(ids: xr.Dataset) -> tuple[str, ...]:
    dims, starts = split_dims(ids["attractor_id"])
    return (*dims, *starts)


def _cells(ids: xr.Dataset, name: str) -> np.ndarray:
    return np.asarray(ids[name].transpose(*_dims(ids)).values)


def left_out(ids: xr.Dataset) -> str:
    """Return a text on how many cells end on no attractor, and why; an empty text if all cells end on attractors."""
    return sentence(ids) if other_cells(ids) else ""


def sentence(ids: xr.Dataset) -> str:
    """Return a text on how many cells end on attractors, and what happens to the others."""
    return told(ids["attractor_id"].size, {name: int(which.sum()) for name, which in other_cells(ids).items()})


def pointed(text: str, has_others: bool) -> str:
    """Return the text of a table on what cells end on, with the page that helps where some end on no attractor."""
    return f"{text} {see('no-attractor')}" if has_others else text


def told(total: int, others: Mapping[str, int]) -> str:
    """Return the text of `sentence` from the number of all cells and those of the others by reason."""
    if not others:
        return f"all {total} cells end on attractors"
    texts = ", ".join(f"{n} {name}" for name, n in others.items())
    return f"{total - sum(others.values())} of {total} cells end on attractors; {texts}"
