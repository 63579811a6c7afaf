"""Collect the distribution of the attractors of runs for draws of a posterior: shares of cells, and section values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.attractors.matching.across import match_across
from pipeline.analysis.ragged import dense
from pipeline.analysis.tabular import FEW_POINTS, points_of, words_of
from pipeline.layout.vocabulary import model_of, parameter_name

Rows = list[dict[str, Any]]

Row = Callable[[str, str, float, np.ndarray, int], dict[str, Any]]
"""Function that makes a row: what, name, value of the best run, values of the draws that have it, and their number."""


def attractor_rows(runs: Sequence[xr.Dataset], row: Row) -> tuple[Rows, Rows]:
    """Return rows on the attractors of all runs, and those of them that are printed.

    Parameters
    ----------
    runs
        Results of the analysis ``attractors``: the best run first, then those of the draws.
    row
        Function that makes a row.

    Returns
    -------
    tuple of list
        For each attractor the ``share`` of all cells, and at each parameter point the share of its cells and the mean
        of the section points in each state, over the draws that have it there; angles about their circular mean. Shares
        of draws without it are 0. With more than `FEW_POINTS` parameter points only the shares of all cells are
        printed.
    """
    ids = match_across(runs)
    runs = [dense(run, points=True) for run in runs]
    n = 1 + max((int(own.max(initial=-1)) for own in ids), default=-1)
    all_rows: Rows = []
    printed: Rows = []
    dims = [str(d) for d in runs[0]["kind"].dims if d != "attractor"]
    n_points = int(np.prod([runs[0].sizes[d] for d in dims]))
    for number in range(n):
        members = [_member(run, own, number) for run, own in zip(runs, ids, strict=True)]
        shares = np.array([0.0 if one is None else float(one["share"].mean()) for one in members])
        whole = row("share", _named(number, members), shares[0], shares[1:], int(np.count_nonzero(shares[1:])))
        places = list(_at_points(runs[0], members, number, dims, row))
        all_rows += [whole, *places]
        printed += [whole, *(places if n_points <= FEW_POINTS else [])]
    return all_rows, printed


def _member(run: xr.Dataset, ids: np.ndarray, number: int) -> xr.Dataset | None:
    """Return the attractor with a common id in one run; None if the run does not have it."""
    rows = np.flatnonzero(ids == number)
    return run.isel(attractor=int(rows[0])) if len(rows) else None


def _named(number: int, members: Sequence[xr.Dataset | None]) -> str:
    """Return the name of an attractor: its id, with kind and period where it was seen first."""
    first = next(one for one in members if one is not None)
    there = int(np.flatnonzero(first["kind"].values.ravel() > 0)[0])
    kind = words_of(first["kind"])[int(first["kind"].values.ravel()[there])].replace("_", " ")
    period = int(first["orbit_period"].values.ravel()[there])
    return f"attractor {number} ({kind}{f', period {period}' if period else ''})"


def _at_points(
    reference: xr.Dataset, members: Sequence[xr.Dataset | None], number: int, dims: Sequence[str], row: Row
) -> Iterator[dict[str, Any]]:
    """Yield the rows of an attractor at each parameter point at which a run has it."""
    is_angle = np.asarray(model_of(reference).is_angle, bool)
    for at, values in points_of(reference, dims):
        own = [None if one is None else one.isel(at) for one in members]
        there = [one is not None and float(one["share"]) > 0.0 for one in own]
        if not any(there):
            continue
        place = ", ".join(f"{parameter_name(d)} = {v:g}" for d, v in values.items())
        name = f"attractor {number}" + (f" at {place}" if place else "")
        shares = np.array([0.0 if one is None else float(one["share"]) for one in own])
        yield row("share", name, shares[0], shares[1:], int(sum(there[1:])))
        means = np.array(
            [
                _mean_section(one, is_angle) if one is not None and t else np.full(len(is_angle), np.nan)
                for one, t in zip(own, there, strict=True)
            ]
        )
        for k, state in enumerate(reference["state"].values):
            column = _about(means[:, k]) if is_angle[k] else means[:, k]
            known = column[1:][np.isfinite(column[1:])]
            yield row(f"section {state}", name, float(column[0]), known, len(known))


def _mean_section(one: xr.Dataset, is_angle: np.ndarray) -> np.ndarray:
    """Return the mean of an attractor's section points in each state; of angles the circular mean."""
    points = one["attractor_points"].transpose("point", "state").values
    points = points[np.isfinite(points).all(axis=1)]
    turned = np.angle(np.exp(1j * np.where(is_angle, points, 0.0)).mean(axis=0))
    return np.asarray(np.where(is_angle, turned, points.mean(axis=0)))


def _about(angles: np.ndarray) -> np.ndarray:
    """Return angles within half a turn of their circular mean, so that their quantiles have a meaning."""
    known = angles[np.isfinite(angles)]
    centre = np.angle(np.exp(1j * known).mean())
    with np.errstate(invalid="ignore"):
        return np.asarray(centre + np.angle(np.exp(1j * (angles - centre))))
