"""Define the analysis ``basins``: the outcomes of a sweep's cells, basin fractions and boundaries, and their table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.basins.boundaries import (
    basin_entropy,
    box_sides,
    boxes_per_side,
    epsilons_of,
    scattered_entropy,
    uncertainty_exponent,
)
from pipeline.analysis.basins.declaration import OTHERS, BasinOptions, share_name
from pipeline.analysis.basins.numbers import basin_rows
from pipeline.analysis.basins.wada import wada_merge_test
from pipeline.layout import vocabulary
from pipeline.layout.vocabulary import letter, split_dims
from pipeline.products.product import Table
from pipeline.products.reporting import track
from pipeline.results.expressions import check_density, weights_of
from pipeline.results.intervals import binomial_interval
from pipeline.results.outcomes import DIVERGED, other_cells, outcomes, pointed, told
from pipeline.results.ragged import dims_of, places_of_rows
from pipeline.results.run import OpenRun
from pipeline.results.selection import start_states
from pipeline.results.tabular import (
    FEW_POINTS,
    FRACTION,
    Row,
    Words,
    largest_share,
    leading,
    point_table,
    points_of,
    ranges,
    summary,
    with_interval,
)


def needs_starts(run: OpenRun, options: BasinOptions) -> None:
    """Raise ValueError unless the run's cells are independent initial conditions."""
    check_starts(run.cube())
    check_density(run, options.density)


def basins(run: OpenRun, options: BasinOptions) -> xr.Dataset:
    """Compute the basins of attraction of a sweep: the outcomes of its cells, the basin fractions and the basin
    boundaries.
    """
    found = run.derive("attractors")
    return basins_of(run.cube(), found, options)


def basins_table(ds: xr.Dataset) -> Table:
    """Return the table of basins. It has one row per outcome and parameter point, with the number of cells and the
    basin fraction.

    The lines have a table per point if there are few, otherwise ranges; the boundaries follow.
    """
    rows, dims = _rows(ds), dims_of(ds)
    confidence = f"{100 * ds.attrs['basin_confidence']:g} %"
    density = str(ds.attrs["basin_density"])
    of = "all cells" if density == "1" else f"the density {density}"
    lines = [f"fractions of {of}, {ds.attrs['basin_interval']}, {confidence}"]
    if int(np.prod([ds.sizes[d] for d in dims])) > FEW_POINTS:
        shown, n_others = leading([row for row in rows if row["label"] != NO_OUTCOME], "label", "n_cells")
        lines += summary(ds, shown, dims, _label_summary, "label")
        lines += [f"  and {n_others} smaller ones; all are in --csv and --json"] if n_others else []
        others = [row for row in rows if row["label"] == NO_OUTCOME]
        lines += summary(ds, others, dims, _label_summary, "outcome") if others else []
        lines += [_range_line(ds, name, text) for name, text in _BOUNDARY.items() if name in ds]
    else:
        for at, where in points_of(ds, dims):
            one = ds.isel(at)
            table = point_table(ds, where, rows, _basin_words)
            lines += table
            if len(table) > 1:
                bound = float(one["unseen_high"])
                lines.append(f"  an attractor that no cell shows: at most {bound:.3g} of the region")
            lines += _boundary_lines(one)
    lines += [f"not computed: {reason}" for reason in ds.attrs["not_computed"].splitlines()]
    return Table(rows, [*lines, _sentence(ds)])


def _rows(ds: xr.Dataset) -> list[Row]:
    """Return a row for each outcome at each parameter point, and one for each reason why cells have none."""
    dims = dims_of(ds)
    columns = dict(zip(dims, places_of_rows(ds, dims), strict=True))
    label = ds["attractor"].values
    words = np.where(label == DIVERGED, "diverged", "attractor")
    columns |= {"label": label, "outcome": words, "n_cells": ds["count"].values}
    columns |= {name: ds[name].values for name in ("n_inferred", *FRACTION, "fraction_if_all", "high_if_all")}
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*(c.tolist() for c in columns.values()), strict=True)]
    return rows + [
        _other_row(ds, at, where, name) for at, where in points_of(ds, dims) for name in OTHERS if ds[name].isel(at) > 0
    ]


def _other_row(ds: xr.Dataset, at: Mapping[str, int], where: Row, name: str) -> Row:
    """Return the row of the cells of a parameter point that have no outcome for one reason."""
    count, share, n = (float(ds[key].isel(at)) for key in (name, share_name(name), "n_effective"))
    settings: dict[str, Any] = {"confidence": ds.attrs["basin_confidence"], "method": ds.attrs["basin_interval"]}
    low, high = (float(end) for end in binomial_interval(share * n, n, **settings))
    told = {"label": NO_OUTCOME, "outcome": OTHERS[name], "n_cells": int(count), "n_inferred": 0}
    return {**where, **told, "fraction": share, "low": low, "high": high, "fraction_if_all": share, "high_if_all": high}


NO_OUTCOME = -1
"""Label of the rows of cells without an outcome."""


def _sentence(ds: xr.Dataset) -> str:
    counts = {"diverged": int(ds["count"].values[ds["attractor"].values == DIVERGED].sum())}
    counts |= {text: int(ds[name].sum()) for name, text in OTHERS.items()}
    counts = {text: n for text, n in counts.items() if n}
    return pointed(told(ds["outcome"].size, counts), bool(counts))


def _basin_words(row: Row) -> Words:
    unfinished, is_attractor = row["fraction_if_all"] > row["fraction"], row["outcome"] == "attractor"
    return {
        "id": str(row["label"]) if is_attractor else row["outcome"],
        "cells": str(row["n_cells"]),
        "fraction": with_interval(row, FRACTION, ".4f"),
        "with the unfinished": f"{row['low']:.4f} to {row['high_if_all']:.4f}" if unfinished else None,
        "letter": letter(row["label"]) if is_attractor else "-",
        "inferred cells": str(row["n_inferred"] or "") or None,
    }


def _label_summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> Words:
    first = _basin_words(rows[0])
    return {
        "id": first["id"],
        **ranges(ds, rows, dims),
        "cells": str(sum(r["n_cells"] for r in rows)),
        "max fraction": largest_share(ds, rows, dims),
        "letter": first["letter"],
        "inferred cells": str(sum(r["n_inferred"] for r in rows) or "") or None,
    }


_BOUNDARY = {
    "basin_entropy": "basin entropy",
    "boundary_basin_entropy": "boundary basin entropy",
    "uncertainty_exponent": "uncertainty exponent",
    "wada_beyond": "cells off the common boundary (Wada)",
}


def _boundary_lines(one: xr.Dataset) -> list[str]:
    lines = []
    for name, text in _BOUNDARY.items():
        if name in one and np.isfinite(float(one[name])):
            value, error, low, high = (float(one[f"{name}{end}"]) for end in ("", "_stderr", "_low", "_high"))
            known = f"± {error:.2g} ({low:.4g} to {high:.4g})"
            lines.append(f"  {text}: {value:.4g} {known if np.isfinite(error) else '(error not known)'}")
    if int(one.get("above_ln2_surely", -1)) == 1:
        lines.append("  the boundary basin entropy exceeds ln 2: the boundary is fractal")
    if int(one.get("wada", -1)) >= 0:
        verdict = "passes" if int(one["wada"]) else "does not pass"
        lines.append(
            f"  Wada merge test: {verdict} with radius {one.attrs['basin_radius']} "
            f"(it takes {float(one['wada_distance']):g} cells)"
        )
    return lines


def _range_line(ds: xr.Dataset, name: str, text: str) -> str:
    values = ds[name].values[np.isfinite(ds[name].values)]
    if not values.size:
        return f"  {text}: nowhere"
    return f"  {text}: {values.min():.4g} to {values.max():.4g} at {values.size} points"


def basins_of(ds: xr.Dataset, ids: xr.Dataset, options: BasinOptions | None = None, **changes: Any) -> xr.Dataset:
    """Compute the basins of attraction at each parameter point of a sweep, with fractions and boundaries.

    Parameters
    ----------
    ds
        Cube of a sweep.
    ids
        Result of `match` or `identify` for the cube.
    options
        By default the defaults of `BasinOptions`. See `pipeline.results.intervals.binomial_interval` for the
        intervals, `boundaries.basin_entropy` for the boxes, `boundaries.uncertainty_exponent` for the scaling, and
        `wada.wada_merge_test` for radius and metric.
    changes
        Fields of `BasinOptions`, used if `options` is None.

    Returns
    -------
    Dataset
        On the cells: `attractor_id`, `decision`, `status`, `n_periods`, and `outcome`, the attractor that a
        cell ends on, -2 where it diverged, -1 else (`pipeline.results.outcomes`). One row (`pipeline.results.ragged`)
        for each outcome of cells at each parameter point, with `attractor`, the id or -2: the variables of
        `numbers.basin_rows`, in which cells without an outcome count as unfinished. On the
        parameter dims the number of the latter by reason, such as `n_not_settled` and `n_no_return` (`OTHERS`);
        they add up to `n_unfinished`.

        If the starts are scattered, `basin_entropy` and `boundary_basin_entropy` as below, of boxes with as many cells
        on average as on a grid.

        If the starts are a grid, evenly spaced along every axis, on the parameter dims:
        `basin_entropy`, `boundary_basin_entropy`, `uncertainty_exponent`, `wada_beyond`, each with
        `_stderr`, `_low`, `_high`; `above_ln2_surely`, `boundary_dimension`, `exponent_r_squared`;
        `wada_distance`, the smallest radius [cells] that passes the Wada test; `wada`: 1 passes with
        `radius`, 0 does not, -1 fewer than three labels; and `uncertain`, also on `epsilon`. A number that
        the grid does not allow is NaN, and the attribute ``not_computed`` gives the reason.

    Raises
    ------
    ValueError
        If the cube is a continuation, or an option is out of bounds.
    """
    options = options or BasinOptions(**changes)
    check_starts(ds)
    dims, start_dims = split_dims(ids["attractor_id"])
    labels = outcomes(ids).transpose(*dims, *start_dims)
    result = ids[["attractor_id", "decision", "status", "ran_out"]]
    result["n_periods"] = ds["n_periods"].transpose(*dims, *start_dims).load()
    result["outcome"] = labels
    inferred = (ids["status"] == vocabulary.INFERRED).transpose(*dims, *start_dims)
    n_points = int(np.prod(labels.shape[: len(dims)]))
    weights = np.ones((n_points, labels.size // n_points))
    if options.density != "1":
        weights = weights_of(ds, dims, start_dims, options.density)
    result = result.merge(basin_rows(labels, dims, inferred, options.confidence, options.interval, weights))
    result = result.assign(_unfinished(ids, dims, weights))
    if reason := _no_grid(ds, start_dims):
        missing = {"boundaries": reason}
        if "initial_condition" in start_dims:
            states = start_states(ds, start_dims)
            missing = {"uncertainty exponent and Wada test": reason, **_too_few(states, options)}
            if "basin entropy" not in missing:
                result = result.assign(_entropies(labels, dims, states, options))
    else:
        missing = _problems(labels.shape[len(dims) :], options)
        result = result.assign(_boundaries(labels, dims, options, missing))
    about = {f"basin_{name}": getattr(options, name) for name in type(options).model_fields}
    reasons = "\n".join(f"{name}: {reason}" for name, reason in missing.items())
    return result.assign_attrs({**ids.attrs, **about, "not_computed": reasons})


def check_starts(ds: xr.Dataset) -> None:
    """Raise ValueError unless each parameter point has several cells with independent initial conditions."""
    if "branch" in ds["status"].dims:
        raise ValueError(
            'basins need independent initial conditions, a sweep (kind = "sweep"): where a branch of a '
            "continuation starts is the end of its last point."
        )
    if not split_dims(ds["status"])[1]:
        raise ValueError("basins need several initial conditions per parameter point; this run has one.")


def _unfinished(ids: xr.Dataset, dims: tuple[str, ...], weights: np.ndarray) -> dict[str, xr.DataArray]:
    """Count the cells without an outcome at each parameter point by reason, and give their share of the weight."""
    others = other_cells(ids)
    shape = ids["attractor_id"].transpose(*dims, ...).shape
    found = {}
    for name, reason in OTHERS.items():
        which = others.get(reason, np.zeros(shape, bool))
        cells = which.reshape(weights.shape)
        share = (weights * cells).sum(axis=1) / weights.sum(axis=1)
        for key, values in ((name, cells.sum(axis=1, dtype=np.int64)), (share_name(name), share)):
            found[key] = xr.DataArray(values.reshape(shape[: len(dims)]), dims=dims)
    return found


def _no_grid(ds: xr.Dataset, start_dims: tuple[str, ...]) -> str:
    if "initial_condition" in start_dims:
        return "the starts are no grid"
    for dim in start_dims:
        steps = np.diff(ds[dim].values)
        if np.ptp(steps) > 1e-6 * np.abs(steps).max(initial=0.0):
            return f"{dim} is not evenly spaced"
    return ""


def _too_few(states: np.ndarray, options: BasinOptions) -> dict[str, str]:
    """Return why scattered starts have no basin entropy, by the name of the measure."""
    varying = states[:, np.ptp(states, axis=0) > 0.0]
    try:
        boxes_per_side(varying.shape, options.box ** varying.shape[1])
    except ValueError as error:
        return {"basin entropy": str(error)}
    return {}


def _entropies(
    labels: xr.DataArray, dims: tuple[str, ...], states: np.ndarray, options: BasinOptions
) -> dict[str, Any]:
    """Measure the basin entropy of scattered starts at each parameter point; return variables as (dims, values)."""
    common: dict[str, Any] = {name: getattr(options, name) for name in ("resamples", "confidence", "seed")}
    per_box = options.box ** int((np.ptp(states, axis=0) > 0.0).sum())
    points = []
    for one in track([*labels.values.reshape(-1, len(states))], "measuring basin entropies"):
        known = (one != -1).any()
        points.append(dict(_of_entropy(scattered_entropy(states, one, per_box, **common))) if known else {})
    names = [name for name in _MEASURES if "basin_entropy" in name or name == "above_ln2_surely"]
    return _over_points(points, names, labels.shape[: len(dims)], dims)


def _problems(shape: tuple[int, ...], options: BasinOptions) -> dict[str, str]:
    """Return why measures of the boundaries cannot be computed on a grid, by measure."""
    found = {}
    checks: dict[str, Callable[[], object]] = {
        "basin entropy": lambda: box_sides(options.box, shape),
        "uncertainty exponent": lambda: epsilons_of(None, shape, options.scaling),
    }
    for name, check in checks.items():
        try:
            check()
        except ValueError as error:
            found[name] = str(error)
    return found


_FLAGS = ("above_ln2_surely", "wada")
_WITH_ERRORS = ("basin_entropy", "boundary_basin_entropy", "uncertainty_exponent", "wada_beyond")
_ERRORS = ("stderr", "low", "high")
_MEASURES = (
    *(f"{name}{end}" for name in _WITH_ERRORS for end in ("", *(f"_{error}" for error in _ERRORS))),
    "boundary_dimension",
    "exponent_r_squared",
    "wada_distance",
    *_FLAGS,
)
"""Measures of the boundaries."""


def _boundaries(
    labels: xr.DataArray, dims: tuple[str, ...], options: BasinOptions, missing: Mapping[str, str]
) -> dict[str, Any]:
    """Measure the basin boundaries at each parameter point; return variables as (dims, values)."""
    shape, grid = labels.shape[: len(dims)], labels.shape[len(dims) :]
    points = [
        dict(_boundary(one, options, missing))
        for one in track([*labels.values.reshape(-1, *grid)], "measuring boundaries")
    ]
    found = _over_points(points, _MEASURES, shape, dims)
    if "uncertainty exponent" not in missing:
        epsilon = epsilons_of(None, grid, options.scaling)
        values = np.array([point.get("uncertain", np.full(len(epsilon), np.nan)) for point in points])
        found["uncertain"] = ((*dims, "epsilon"), values.reshape(*shape, len(epsilon)))
        found["epsilon"] = ("epsilon", epsilon)
    return found


def _over_points(
    points: Sequence[Mapping[str, Any]], names: Sequence[str], shape: tuple[int, ...], dims: tuple[str, ...]
) -> dict[str, Any]:
    """Return measures of parameter points as (dims, values), NaN where a point has none, or -1 of flags."""
    found: dict[str, Any] = {}
    for name in names:
        is_flag = name in _FLAGS
        values = np.array([point.get(name, -1 if is_flag else np.nan) for point in points])
        found[name] = (dims, values.astype(np.int8 if is_flag else np.float64).reshape(shape))
    return found


def _of_entropy(entropy: xr.Dataset) -> Iterator[tuple[str, Any]]:
    """Yield the name and value of each measure of basin entropies."""
    for ours, theirs in (("basin_entropy", "entropy"), ("boundary_basin_entropy", "boundary_entropy")):
        yield from _with_errors(entropy, ours, theirs)
    if np.isfinite(entropy["boundary_entropy_low"]):
        yield "above_ln2_surely", int(entropy["above_ln2_surely"])


def _boundary(grid: np.ndarray, options: BasinOptions, missing: Mapping[str, str]) -> Iterator[tuple[str, Any]]:
    """Yield the name and value of each measure of the basin boundaries on one grid of labels."""
    if not (grid != -1).any():
        return
    common: dict[str, Any] = {name: getattr(options, name) for name in ("resamples", "confidence", "seed")}
    if "basin entropy" not in missing:
        yield from _of_entropy(basin_entropy(grid, options.box, block=options.block, **common))
    if "uncertainty exponent" not in missing:
        exponent = uncertainty_exponent(grid, method=options.scaling, **common)
        yield from _with_errors(exponent, "uncertainty_exponent", "exponent")
        yield "boundary_dimension", float(exponent["boundary_dimension"])
        yield "exponent_r_squared", float(exponent["r_squared"])
        yield "uncertain", exponent["uncertain"].values
    if np.unique(grid[grid != -1]).size >= 3:
        wada = wada_merge_test(grid, options.radius, metric=options.metric, **common).isel(radius=0)
        yield from _with_errors(wada, "wada_beyond", "beyond")
        yield "wada_distance", float(wada["hausdorff_distance"])
        yield "wada", int(wada["wada"])


def _with_errors(ds: xr.Dataset, ours: str, theirs: str) -> Iterator[tuple[str, float]]:
    yield ours, float(ds[theirs])
    for end in _ERRORS:
        yield f"{ours}_{end}", float(ds[f"{theirs}_{end}"])
