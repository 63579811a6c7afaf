"""Measure the complexity of basin boundaries: basin entropy and uncertainty exponent.

Both read a grid of labels (see `labels`) with one cell per initial condition, evenly spaced along each axis,
in any number of dimensions. Their values depend on the resolution of the grid and on the boxes: compare only
basins with the same resolution and boxes. Errors come from resampling parts of the grid. They estimate the
difference from a similar region, not from a finer grid.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from pipeline.analysis.basins.labels import (
    UNFINISHED,
    Codes,
    Floats,
    Ints,
    bootstrap_weights,
    check_confidence,
    check_resamples,
    read_labels,
    spread,
    tile_numbers,
    tile_sums,
    tiles_per_side,
)

ABOVE_LN_2 = float(np.log(2.0)) * (1.0 + 1e-12)
"""Boundary basin entropy above which the boundary must be fractal: ln 2, with the rounding of a mean."""

Scaling = Literal["perturbation", "boxes", "entropy"]

_EXPONENT_REFERENCES = {
    "perturbation": "McDonald, Grebogi, Ott and Yorke, Physica D 17, 125 (1985)",
    "boxes": "McDonald, Grebogi, Ott and Yorke, Physica D 17, 125 (1985)",
    "entropy": "Daza et al., Sci. Rep. 6, 31416 (2016)",
}


class _Boxes(NamedTuple):
    """Content of each box of a grid of labels: entropy [nat], number of labels, number of finished cells."""

    entropy: Floats
    n_labels: Ints
    n_finished: Ints


def basin_entropy(
    labels: npt.ArrayLike | xr.DataArray,
    box: int | Sequence[int] = 5,
    *,
    unfinished: Collection[int] = UNFINISHED,
    block: int = 1,
    resamples: int = 200,
    confidence: float = 0.95,
    seed: int = 0,
) -> xr.Dataset:
    """Compute the basin entropy and the boundary basin entropy of a grid of labels, with bootstrap errors.

    The entropy of a box is the entropy of its labels, ``S_i = sum_j p_ij ln(1/p_ij)``. The basin entropy is the
    mean over boxes, and the boundary basin entropy the mean over boxes with two labels or more (Daza, Wagemakers,
    Georgeot, Guéry-Odelin and Sanjuán, Sci. Rep. 6, 31416, 2016). If the boundary basin entropy exceeds ln 2 the
    boundary is fractal, since a smooth boundary separates two basins in nearly every box. The converse does not
    hold: two labels never exceed ln 2.

    The basin entropy is the mean over all places of the box in the grid: boxes side by side would miss a straight
    border that falls between two of them. The boundary basin entropy is that of the boxes side by side from the
    first cell on, as published values are; if no border crosses these, it is the mean over all places.

    Errors come from a bootstrap of the boxes side by side, for every placement of them; the largest counts.

    Parameters
    ----------
    labels
        Outcome per cell of a regular grid, integers, any number of dims.
    box
        Side of a box [cells], one for all dims or one each.
    unfinished
        Codes of cells whose outcome is not known. These cells are left out of their box, and a box that
        has no others is left out of the means. With ``()`` all codes count as labels.
    block
        Side of the square of boxes that the bootstrap draws as one. Neighbouring boxes are similar: with 1
        boxes are drawn singly, and the errors are too small for structures wider than a box.
    resamples, confidence, seed
        Bootstrap samples, level of the percentile intervals, seed.

    Returns
    -------
    Dataset
        `entropy` and `boundary_entropy` [nat], each with `_stderr`, `_low`, `_high`; of the boxes side by side from
        the first cell on `n_boxes`, `n_boundary_boxes`, and `fraction_used`, the part of the cells in them;
        `n_labels`, `fraction_unfinished`; `above_ln2`, whether the
        boundary entropy exceeds ln 2; `above_ln2_surely`, whether the lower end of its interval does.
        Without a boundary box the boundary entropy is NaN. Errors are NaN with fewer than 5
        (boundary) boxes, or squares of boxes, to draw from. Boxes should be small against the basins;
        this is not validated.

    Raises
    ------
    TypeError
        If the labels are not integers.
    ValueError
        If a box holds one cell only or is larger than the grid, or `block`, `resamples` or `confidence`
        is out of range.
    """
    check_confidence(confidence)
    check_resamples(resamples)
    grid = read_labels(labels, unfinished)
    sides = box_sides(box, grid.codes.shape)
    if block < 1:
        raise ValueError(f"block is {block}, below 1: give the number of boxes drawn as one, per side")
    boxes = _fill_boxes(grid.codes, sides)
    parts = np.stack([boxes.entropy, boxes.n_finished > 0, boxes.n_labels > 1])
    placements = [parts[(slice(None), *where)] for where in _placements(sides, boxes.entropy.shape)]
    first, everywhere = _entropies(_totals(placements[0])), _entropies(_totals(parts))
    value = np.array([everywhere[0], first[1] if np.isfinite(first[1]) else everywhere[1]])
    errors = np.array([_placement_errors(one, block, resamples, confidence, seed) for one in placements])
    # fmax skips placements without an error
    stderr, below, above = np.fmax.reduce(errors, axis=0)
    low, high = np.maximum(value - below, 0.0), value + above
    _, n_boxes, n_boundary = _totals(placements[0])
    ds = xr.Dataset()
    long_names = {"entropy": "basin entropy", "boundary_entropy": "boundary basin entropy"}
    for i, (name, long_name) in enumerate(long_names.items()):
        ds[name] = ((), value[i], {"long_name": long_name, "units": "nat"})
        for end, of in (("stderr", stderr), ("low", low), ("high", high)):
            ds[f"{name}_{end}"] = ((), of[i])
    return ds.assign(
        n_boxes=int(n_boxes),
        n_boundary_boxes=int(n_boundary),
        n_labels=grid.ids.size,
        fraction_used=float(placements[0][0].size * np.prod(sides) / grid.codes.size),
        fraction_unfinished=grid.fraction_unfinished,
        above_ln2=bool(value[1] > ABOVE_LN_2),
        above_ln2_surely=bool(low[1] > ABOVE_LN_2),
    ).assign_attrs(
        box=list(sides),
        block=block,
        resamples=resamples,
        confidence=confidence,
        seed=seed,
        unfinished_codes=sorted(unfinished),
        references=_EXPONENT_REFERENCES["entropy"],
    )


def uncertainty_exponent(
    labels: npt.ArrayLike | xr.DataArray,
    *,
    epsilons: Sequence[int] | None = None,
    method: Scaling = "perturbation",
    unfinished: Collection[int] = UNFINISHED,
    resamples: int = 200,
    confidence: float = 0.95,
    seed: int = 0,
) -> xr.Dataset:
    """Compute the uncertainty exponent alpha of basin boundaries: the uncertain fraction scales as ``f(eps) ~
    eps**alpha``.

    alpha is the dimension of the region minus that of the boundary: 1 for a smooth boundary, and near 0 if
    more precise initial conditions hardly improve the prediction (McDonald, Grebogi, Ott and Yorke,
    Physica D 17, 125, 1985; Grebogi, McDonald, Ott and Yorke, Phys. Lett. A 99, 415, 1983). It is the
    least-squares slope of ln f against ln eps.

    Parameters
    ----------
    labels
        Outcome per cell of a regular grid, integers, any number of dims.
    epsilons
        Perturbations or box sides [cells], at least three; None: twelve or fewer, evenly spaced in the
        logarithm, up to a tenth of the shortest side.
    method
        Definition of f. ``"perturbation"`` (the definition of 1985): the fraction of cells whose outcome
        differs from that of the cell `eps` before or after it along an axis, all axes pooled; every cell
        far enough from the edge for the largest `eps` is a trial. ``"boxes"`` (box counting): the fraction
        of boxes of side `eps` with more than one label; small boxes have few cells, so the smallest sides
        bias the slope. ``"entropy"``: the basin entropy with boxes of side `eps`, which scales in the same
        way (Daza et al., Sci. Rep. 6, 31416, 2016).
    unfinished
        Codes of cells whose outcome is not known. Trials with these cells are left out; boxes use their
        other cells.
    resamples, confidence, seed
        Bootstrap samples of tiles of the grid, level of the percentile interval, seed.

    Returns
    -------
    Dataset
        `exponent`; `exponent_stderr_fit` from the scatter about the line, too small since all points
        come from the same grid; `exponent_stderr`, `exponent_low`, `exponent_high` from fits to about 64
        tiles drawn with replacement; `boundary_dimension`; `intercept`, `r_squared`;
        `fraction_unfinished`. On `epsilon`: `uncertain`, which is f; `used`, whether f > 0 and so part of
        the fit; `fitted`. NaN with fewer than three usable points, for example without a boundary. A power
        law is assumed and not validated: look at the points.

    Raises
    ------
    TypeError
        If the labels are not integers.
    ValueError
        If there are fewer than three different `epsilons`, or one that does not fit into the grid, or
        `method`, `resamples` or `confidence` is out of range.
    """
    check_confidence(confidence)
    check_resamples(resamples)
    if method not in _EXPONENT_REFERENCES:
        raise ValueError(f"method is {method!r}: use one of {sorted(_EXPONENT_REFERENCES)}")
    grid = read_labels(labels, unfinished)
    shape = grid.codes.shape
    eps = epsilons_of(epsilons, shape, method)
    if method == "perturbation":
        trials, hits = _perturbed(grid.codes, eps)
    else:
        trials, hits = _boxed(grid.codes, eps, method)
    uncertain = _ratio(hits.sum(axis=1), trials.sum(axis=1))
    fit = _fit_line(eps, uncertain)
    weights = bootstrap_weights(trials.shape[1], resamples, seed)
    slopes = np.array([_fit_line(eps, _ratio(hits @ w, trials @ w)).slope for w in weights])
    stderr, low, high = spread(slopes, confidence)
    return xr.Dataset(
        {
            "exponent": ((), fit.slope, {"long_name": "uncertainty exponent", "units": "1"}),
            "exponent_stderr": ((), stderr),
            "exponent_low": ((), low),
            "exponent_high": ((), high),
            "exponent_stderr_fit": ((), fit.stderr),
            "boundary_dimension": ((), len(shape) - fit.slope),
            "intercept": ((), fit.intercept),
            "r_squared": ((), fit.r_squared),
            "fraction_unfinished": ((), grid.fraction_unfinished),
            "uncertain": ("epsilon", uncertain),
            "used": ("epsilon", uncertain > 0.0),
            "fitted": ("epsilon", np.exp(fit.intercept) * eps**fit.slope),
        },
        coords={"epsilon": ("epsilon", eps, {"units": "cells"})},
        attrs={
            "method": method,
            "resamples": resamples,
            "confidence": confidence,
            "seed": seed,
            "unfinished_codes": sorted(unfinished),
            "references": _EXPONENT_REFERENCES[method],
        },
    )


def scattered_entropy(
    states: npt.ArrayLike,
    labels: npt.ArrayLike,
    per_box: int = 25,
    *,
    unfinished: Collection[int] = UNFINISHED,
    resamples: int = 200,
    confidence: float = 0.95,
    seed: int = 0,
) -> xr.Dataset:
    """Compute the basin entropy and the boundary basin entropy of cells with scattered initial states.

    Boxes of equal size divide the region of the states, with `per_box` cells each on average; otherwise as
    `basin_entropy`, which is for grids. The mean is over 16 random placements of the boxes. A box of few cells has too
    small an entropy, about (labels - 1)/(2 cells) below that of many.

    Parameters
    ----------
    states
        Initial states of the cells, shape (cell, state), evenly distributed in a region; states that are the same
        everywhere do not count.
    labels
        Outcome per cell, integers, shape (cell,).
    per_box
        Mean number of cells in a box, 2 or more.
    unfinished, resamples, confidence, seed
        See `basin_entropy`.

    Returns
    -------
    Dataset
        `entropy` and `boundary_entropy` [nat], each with `_stderr`, `_low`, `_high`, `n_boxes` and
        `n_boundary_boxes` of the first placement, and `above_ln2_surely`.

    Raises
    ------
    TypeError
        If the labels are not integers.
    ValueError
        If the cells do not fill two boxes along each state.
    """
    n_placements = 16
    check_confidence(confidence)
    check_resamples(resamples)
    codes = read_labels(labels, unfinished).codes
    points = np.asarray(states, np.float64)
    points = points[:, np.ptp(points, axis=0) > 0.0]
    side = boxes_per_side(points.shape, per_box)
    places = (points - points.min(axis=0)) / np.ptp(points, axis=0) * side
    rng = np.random.default_rng(seed)
    first_boxes = _fill_scattered(codes, places, side)
    # moved by a part of a box, one box less lies within the region
    offsets = rng.random((n_placements - 1, places.shape[1]))
    placements = [first_boxes, *(_fill_scattered(codes, places - offset, side - 1) for offset in offsets)]
    first, everywhere = _totals(placements[0]), _totals(np.concatenate([p.reshape(3, -1) for p in placements], axis=1))
    value = _entropies(everywhere)
    errors = np.array([_placement_errors(one, 1, resamples, confidence, seed) for one in placements])
    stderr, below, above = np.fmax.reduce(errors, axis=0)
    low, high = np.maximum(value - below, 0.0), value + above
    ds = xr.Dataset({"n_boxes": int(first[1]), "n_boundary_boxes": int(first[2])})
    for i, name in enumerate(("entropy", "boundary_entropy")):
        for end, of in (("", value), ("_stderr", stderr), ("_low", low), ("_high", high)):
            ds[f"{name}{end}"] = ((), of[i])
    return ds.assign(above_ln2_surely=bool(low[1] > ABOVE_LN_2))


def boxes_per_side(shape: tuple[int, ...], per_box: int) -> int:
    """Return the number of boxes along each state for cells of shape (cell, state); ValueError if below 2."""
    n, dims = shape
    if per_box < 2:
        raise ValueError(f"a box of {per_box} cells has no entropy: give 2 or more")
    side = int((n / per_box) ** (1.0 / max(dims, 1)) * (1.0 + 1e-12)) if dims else 0
    if side < 2:
        raise ValueError(
            f"{n} scattered cells over {dims} states do not fill two boxes of {per_box} along each of them: "
            f"take {per_box * 2**dims} cells, or smaller boxes"
        )
    return side


def _fill_scattered(codes: Codes, places: Floats, side: int) -> Floats:
    """Return the entropy of each box, whether it has finished cells, and whether it has several labels."""
    known = (codes >= 0) & ((places >= 0.0) & (places <= side)).all(axis=1)
    index = np.minimum(places[known].astype(np.int64), side - 1)
    sides = (side,) * places.shape[1]
    counts = np.zeros((side ** len(sides), int(codes.max(initial=0)) + 1))
    np.add.at(counts, (np.ravel_multi_index(tuple(index.T), sides), codes[known]), 1.0)
    total = counts.sum(axis=1)
    share = counts / np.maximum(total, 1.0)[:, None]
    entropy = -(share * np.log(np.where(share > 0.0, share, 1.0))).sum(axis=1)
    return np.stack([entropy, total > 0, (counts > 0).sum(axis=1) > 1]).reshape(3, *sides)


# --- boxes ---------------------------------------------------------------------------------------------


def box_sides(box: int | Sequence[int], shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the sides of a box along each dim of a grid; ValueError if it does not fit."""
    given = np.atleast_1d(np.asarray(box, dtype=np.int64)).tolist()
    sides = tuple(given) * (len(shape) if len(given) == 1 else 1)
    if len(sides) != len(shape):
        raise ValueError(f"box {box} has {len(sides)} sides, the grid {len(shape)} dims: give 1 or one each")
    if min(sides, default=0) < 1 or int(np.prod(sides)) < 2:
        raise ValueError(f"box {sides} does not hold 2 cells: an entropy needs sides of 2 or more, such as 5")
    if any(side > n for side, n in zip(sides, shape, strict=True)):
        raise ValueError(f"box {sides} is larger than the grid {shape}: use a smaller box or more cells")
    return sides


def _fill_boxes(codes: Codes, sides: tuple[int, ...]) -> _Boxes:
    """Compute the entropy [nat] and count the labels in the box at each place of a grid; unfinished cells are left out.

    The box takes every place at which it lies within the grid: element (i, j, ...) is the box that begins at this cell.
    """
    shape = tuple(size - side + 1 for size, side in zip(codes.shape, sides, strict=True))
    n_labels, n_finished, logs = np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros(shape)
    counts = np.arange(1 + int(np.prod(sides)))
    times_log = counts * np.log(np.maximum(counts, 1))
    for code in np.unique(codes[codes >= 0]):
        count = _box_sums(codes == code, sides)
        n_labels += count > 0
        n_finished += count
        logs += times_log[count]
    # -sum p ln p with p = count/n is ln n - sum(count ln count)/n; a box of one label has exactly 0
    entropy = np.where(n_labels > 1, (times_log[n_finished] - logs) / np.maximum(n_finished, 1), 0.0)
    entropy = np.minimum(entropy, np.log(np.maximum(n_labels, 1)))  # equal labels, off by rounding
    return _Boxes(entropy, n_labels, n_finished)


def _box_sums(values: npt.NDArray[np.bool_], sides: tuple[int, ...]) -> Ints:
    """Count the true cells in the box at each place of a grid."""
    out = values.astype(np.int64)
    for axis, side in enumerate(sides):
        total = np.insert(np.cumsum(out, axis=axis), 0, 0, axis=axis)
        first, last = ([slice(None)] * out.ndim for _ in range(2))
        first[axis], last[axis] = slice(None, -side), slice(side, None)
        out = total[tuple(last)] - total[tuple(first)]
    return np.asarray(out)


def _placements(sides: tuple[int, ...], places: tuple[int, ...]) -> Iterator[tuple[slice, ...]]:
    """Yield slices that cut boxes side by side out of the boxes at all places, for each cell to begin at."""
    begins = (range(min(side, n)) for side, n in zip(sides, places, strict=True))
    for begin in itertools.product(*begins):
        yield tuple(slice(start, None, side) for start, side in zip(begin, sides, strict=True))


def _placement_errors(parts: Floats, block: int, resamples: int, confidence: float, seed: int) -> Floats:
    """Bootstrap both entropies of boxes side by side; return standard errors, and how far the interval reaches below
    and above. NaN if there are too few boxes to draw from.
    """
    fewest = 5  # boxes for an error of their mean: with a single box all resamples are equal
    sums = np.stack([_pool(part, block) for part in parts])
    weights = bootstrap_weights(sums.shape[1], resamples, seed)
    stderr, low, high = spread(np.array([_entropies(sums @ w) for w in weights]), confidence)
    value = _entropies(sums.sum(axis=1))
    errors = np.array([stderr, value - low, high - value])
    errors[:, (sums[1:] > 0).sum(axis=1) < fewest] = np.nan
    return errors


def _totals(parts: Floats) -> Floats:
    return np.asarray(parts.reshape(len(parts), -1).sum(axis=1))


def _pool(values: npt.NDArray[np.generic], block: int) -> Floats:
    """Sum values over blocks of `block` elements per side, and flatten the sums; blocks at the far edges may be
    smaller.
    """
    out = values.astype(np.float64)
    for axis, n in enumerate(values.shape):
        out = np.add.reduceat(out, np.arange(0, n, block), axis=axis)
    return out.ravel()


def _entropies(sums: Floats) -> Floats:
    return _ratio(np.array([sums[0], sums[0]]), sums[1:])


def _ratio(hits: Floats, trials: Floats) -> Floats:
    return np.where(trials > 0.0, hits / np.where(trials > 0.0, trials, 1.0), np.nan)


# --- scaling -------------------------------------------------------------------------------------------


class _Line(NamedTuple):
    """Straight line fitted to ln f over ln eps, where f is the uncertain fraction at the distance eps."""

    slope: float
    intercept: float
    stderr: float
    r_squared: float


def epsilons_of(epsilons: Sequence[int] | None, shape: tuple[int, ...], method: Scaling) -> Ints:
    """Choose or check the perturbations or box sizes epsilon [cells]; ValueError if they do not fit the grid."""
    first = 1 if method == "perturbation" else 2
    shortest = min(shape)
    # a perturbation needs room on both sides, a box must fit
    limit = (shortest - 1) // 2 if method == "perturbation" else shortest
    if epsilons is None:
        last = max(first + 2, shortest // 10)
        eps = np.unique(np.rint(np.geomspace(first, last, 12)).astype(np.int64))
    else:
        eps = np.unique(np.asarray(epsilons, dtype=np.int64))
    if eps.size < 3:
        raise ValueError(f"epsilons {eps.tolist()} are fewer than 3 different ones: a slope needs 3 or more")
    if eps[0] < first or eps[-1] > limit:
        raise ValueError(
            f"epsilons from {eps[0]} to {eps[-1]} are not within {first} and {limit}, which the grid {shape} "
            f"allows for {method!r}: choose others, or use a finer grid"
        )
    return eps


def _perturbed(codes: Codes, eps: Ints) -> tuple[Floats, Floats]:
    """Count for each epsilon the tested cells, and those whose label changes within this distance, in each tile of the
    grid.

    Every epsilon has the same trials: the cells that have room for the largest epsilon. Otherwise f would not
    be a straight line even for a straight boundary.
    """
    n_tiles = tiles_per_side(codes.shape) ** codes.ndim
    trials, hits = np.zeros((eps.size, n_tiles)), np.zeros((eps.size, n_tiles))
    room = int(eps[-1])
    for axis, size in enumerate(codes.shape):
        middle = _window(codes, axis, room, size - room)
        margin = tuple(room if k == axis else 0 for k in range(codes.ndim))
        tile = tile_numbers(middle.shape, codes.shape, margin=margin)
        for i, e in enumerate(eps):
            before = _window(codes, axis, room - int(e), size - room - int(e))
            after = _window(codes, axis, room + int(e), size - room + int(e))
            known = (middle >= 0) & (before >= 0) & (after >= 0)
            trials[i] += tile_sums(known, tile, n_tiles)
            hits[i] += tile_sums(known & ((middle != before) | (middle != after)), tile, n_tiles)
    return trials, hits


def _boxed(codes: Codes, eps: Ints, method: Scaling) -> tuple[Floats, Floats]:
    """Count for each epsilon the boxes with this side, and those with several labels, in each tile of the grid."""
    n_tiles = tiles_per_side(codes.shape) ** codes.ndim
    trials, hits = np.zeros((eps.size, n_tiles)), np.zeros((eps.size, n_tiles))
    for i, e in enumerate(eps):
        sides = (int(e),) * codes.ndim
        boxes = _fill_boxes(codes, sides)
        first = next(_placements(sides, boxes.entropy.shape))
        tile = tile_numbers(boxes.entropy[first].shape, codes.shape, step=int(e))
        trials[i] = tile_sums(boxes.n_finished[first] > 0, tile, n_tiles)
        hits[i] = tile_sums((boxes.entropy if method == "entropy" else boxes.n_labels > 1)[first], tile, n_tiles)
    return trials, hits


def _window(codes: Codes, axis: int, start: int, stop: int) -> Codes:
    return codes[tuple(slice(start, stop) if k == axis else slice(None) for k in range(codes.ndim))]


def _fit_line(eps: Ints, f: Floats) -> _Line:
    """Fit a straight line to ln f over ln eps by least squares, where the uncertain fraction f is above 0; NaN with
    fewer than three points.
    """
    use = f > 0.0
    if use.sum() < 3:
        return _Line(np.nan, np.nan, np.nan, np.nan)
    x, y = np.log(eps[use]), np.log(f[use])
    dx, dy = x - x.mean(), y - y.mean()
    slope = float(dx @ dy / (dx @ dx))
    left = float(((dy - slope * dx) ** 2).sum())
    total = float(dy @ dy)
    stderr = float(np.sqrt(left / (x.size - 2) / (dx @ dx)))
    r_squared = 1.0 - left / total if total > 0.0 else 1.0
    return _Line(slope, float(y.mean() - slope * x.mean()), stderr, r_squared)
