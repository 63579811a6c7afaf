"""Define the analyses ``chaos`` and ``dimension`` of a run, and tabulate them.

    ds = pipeline.open_run(directory)
    cells = chaotic_cells(ds)               # cell by cell; integrates nothing
    found = chaos_of(ds, attractors)        # and per attractor, see `per_attractor`

A mean over cells describes an attractor only if all these cells are on it. So means are taken per attractor.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from pipeline.analysis.chaos.declaration import ChaosOptions, DimensionOptions
from pipeline.analysis.chaos.dimensions import correlation_dimension, kaplan_yorke_dimension
from pipeline.analysis.chaos.lyapunov import CellMotion, is_closed, motion_attrs, summarise
from pipeline.analysis.chaos.per_attractor import Nature, chaos_per_attractor, pooled
from pipeline.analysis.chaos.section_samples import geometry_of
from pipeline.analysis.chaos.zero_one import FEWEST_SECTIONS, zero_one_test
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import APERIODIC, ATTRACTS, KINDS, model_of, split_dims
from pipeline.products.product import Table
from pipeline.results.ragged import N_IDS, ROW_SIZE, SET, dims_of, rows_at
from pipeline.results.run import OpenRun
from pipeline.results.selection import select_points
from pipeline.results.tabular import (
    FEW_POINTS,
    Row,
    Words,
    aligned,
    at_point,
    axis_ranges,
    counted,
    number,
    plain,
    point_table,
    points_of,
    sets_of,
    unit_of,
    values,
    with_error,
    with_interval,
)

_FLAGS = {
    "n_transient": "transient",
    "n_contradicting": "closed with a positive exponent",
    "n_drifting": "drifting",
    "n_audit_failed": "audit failed",
    "n_unresolved": "unresolved",
    "n_failed": "failed",
}

_NUMBERS = ("kaplan_yorke", "kaplan_yorke_stderr", "correlation", "correlation_stderr", "correlation_spread")

_TEST = ("median_zero_one", "least_zero_one", "largest_zero_one")


REASONS = ("absent", "has_dimension", "closed", "does_not_attract", "too_few_points")

ABSENT, HAS_DIMENSION, CLOSED, NO_ATTRACTOR, TOO_FEW = range(len(REASONS))
"""Values of `reason`."""


def chaos(run: OpenRun, options: ChaosOptions) -> xr.Dataset:
    """Compute Lyapunov exponents, dimensions and the 0-1 test for the cells and for each attractor of a run."""
    return chaos_of(run.cube(), run.derive("attractors"), options)


def needs_dimension(run: OpenRun, options: DimensionOptions) -> None:
    """Raise ValueError if the options select an axis, or a value on an axis, that the run's result cube lacks."""
    select_points(run.cube(), options.at)


def settle_dimension(run: OpenRun, options: DimensionOptions) -> DimensionOptions:
    """Replace the selected parameter values by the nearest axis values of the run's result cube, so that stored results
    are found.
    """
    part = select_points(run.cube(), options.at)
    return options.model_copy(update={"at": {name: float(part[name].values[0]) for name in options.at}})


def dimension(run: OpenRun, options: DimensionOptions) -> xr.Dataset:
    """Compute the correlation dimension of each non-periodic attractor of a run."""
    return section_dimension(run.cube(), run.derive("attractors"), options)


def chaos_table(ds: xr.Dataset) -> Table:
    """Return the table of exponents, multipliers, dimensions and the 0-1 test, per attractor and parameter point."""
    dims, _ = split_dims(ds["motion"])
    rows = [{**where, **_row(one)} for where, one in sets_of(ds)]
    n_points = int(np.prod([ds.sizes[d] for d in dims]))
    lines = [f"{ds['motion'].size} cells at {counted(n_points, 'parameter point')}"]
    if n_points > FEW_POINTS:
        lines += _summary(ds, rows, dims)
    else:
        unit = model_of(ds).clock.unit
        for _, where in points_of(ds, dims):
            lines += point_table(ds, where, rows, lambda row: _words(row, unit))
    lines += [f"not computed: {reason}" for reason in ds.attrs["not_computed"].splitlines()]
    return Table(rows, lines)


def _row(one: xr.Dataset) -> Row:
    names = ("kind", "stability", "nature", "orbit_period", "n_cells", "share", "exponents_from", *_FLAGS)
    return {
        "attractor_id": int(one["attractor"]),
        **values(one, *names),
        **_spectrum(one),
        **{name: float(one[f"attractor_{name}"]) for name in _NUMBERS},
        **values(one, *_TEST),
    }


def _spectrum(one: xr.Dataset) -> Row:
    frequency = float(one.coords["frequency"]) if "frequency" in one.coords else np.nan
    row: Row = {}
    for k in range(one.sizes["rank"]):
        for end in ("", "_stderr", "_between"):
            value = float(one[f"attractor_lyapunov{end}"][k])
            row |= {f"lyapunov_{k + 1}{end}": value, f"lyapunov_{k + 1}{end}_per_period": value / frequency}
    for k in range(one.sizes["multiplier"]):
        for part in ("real", "imag"):
            row[f"multiplier_{k + 1}_{part}"] = float(one[f"multiplier_{part}"][k])
    return row


def _words(row: Row, unit: str) -> Words:
    return {
        "id": str(row["attractor_id"]),
        "kind": plain(row["kind"]),
        "stability": plain(row["stability"]),
        "motion": _nature_words(row),
        "period": str(row["orbit_period"] or "-"),
        "cells": str(row["n_cells"]),
        "share": f"{row['share']:.3f}",
        f"exponents per {unit}": _exponents(row),
        "|multipliers|": _multipliers(row),
        "Kaplan-Yorke": with_error(row["kaplan_yorke"], row["kaplan_yorke_stderr"]),
        "correlation": with_error(row["correlation"], row["correlation_stderr"]),
        "0-1 K": with_interval(row, _TEST, ".2f") if np.isfinite(row[_TEST[0]]) else None,
        "flags": _flags([row]) or "-",
    }


def _flags(rows: Sequence[Row]) -> str:
    counts = [(sum(row[name] for row in rows), text) for name, text in _FLAGS.items()]
    return ", ".join(f"{n} {text}" for n, text in counts if n)


def _nature_words(row: Row) -> str:
    return Nature[row["nature"].upper()].words


def _exponents(row: Row) -> str:
    known = [k for k in range(1, 100) if np.isfinite(row.get(f"lyapunov_{k}", np.nan))]
    return ", ".join(with_error(row[f"lyapunov_{k}"], row[f"lyapunov_{k}_stderr"], 4) for k in known) or "-"


def _multipliers(row: Row) -> str:
    moduli = [
        np.hypot(row[f"multiplier_{k}_real"], row[f"multiplier_{k}_imag"])
        for k in range(1, 100)
        if np.isfinite(row.get(f"multiplier_{k}_real", np.nan))
    ]
    return ", ".join(f"{m:.4g}" for m in moduli) or "-"


def _summary(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> list[str]:
    """Return text lines on where each class of motion occurs, on the largest exponent, and on flagged cells."""
    table = []
    for nature in Nature:
        if own := [row for row in rows if row["nature"] == nature.name.lower()]:
            ids = sorted({row["attractor_id"] for row in own})
            words = {
                "motion": nature.words,
                "ids": ", ".join(map(str, ids[:8])) + (f" and {len(ids) - 8} more" if len(ids) > 8 else ""),
                "cells": str(sum(r["n_cells"] for r in own)),
                "points": str(len({tuple(row[d] for d in dims) for row in own})),
            }
            table.append(words | {f"{d}{unit_of(ds, d)}": axis_ranges(ds, d, own, len(dims) == 1) for d in dims})
    return aligned(table) + _extremes(ds, rows, dims) + [f"  cells flagged: {_flags(rows) or 'none'}"]


def _extremes(ds: xr.Dataset, rows: Sequence[Row], dims: Sequence[str]) -> list[str]:
    known = [row for row in rows if np.isfinite(row["lyapunov_1"])]
    if not known:
        return []
    row = max(known, key=lambda r: float(r["lyapunov_1"]))
    rate = with_error(row["lyapunov_1"], row["lyapunov_1_stderr"])
    period = with_error(row["lyapunov_1_per_period"], row["lyapunov_1_stderr_per_period"])
    place = ", ".join(f"{d} {row[d]:g}{unit_of(ds, d)}" for d in dims)
    who = f"attractor {row['attractor_id']}, {_nature_words(row)}"
    unit = model_of(ds).clock.unit
    each = f", {period} per {model_of(ds).clock.period}" if period != "-" and unit == "s" else ""
    return [f"  largest exponent: {rate} per {unit}{each}, {who}, at {place}"]


# ---- correlation dimension ---------------------------------------------------------------------

_CURVE = (
    "correlation_dimension",
    "correlation_dimension_stderr",
    "correlation_dimension_spread",
    "fit_low",
    "fit_high",
    "largest_resolved",
)
_WHY = {
    "closed": "none: it closes",
    "does_not_attract": "none: not shown to attract",
    "too_few_points": "none: too few points for a range to fit",
}


_OPEN = tuple(KINDS[code] for code in APERIODIC)


def dimension_table(ds: xr.Dataset) -> Table:
    """Return the table of correlation dimensions per attractor and parameter point, with the reason where there is no
    dimension.
    """
    dims = dims_of(ds)
    names = ("kind", "reason", "n_cells", "n_sampled", "n_left", "n_points", "lifetime_low", *_CURVE)
    found = sets_of(ds)
    rows = [{**where, "attractor_id": int(one["attractor"]), **values(one, *names)} for where, one in found]
    lines = ["correlation dimension of the sections of attractors that do not close"]
    open_rows = [row for row in rows if row["kind"] in _OPEN]
    if not open_rows:
        lines.append("  none: all sets close, and have the dimension 0 on the section")
    return Table(rows, lines + aligned([_dimension_words(ds, row, dims) for row in open_rows]))


def _dimension_words(ds: xr.Dataset, row: Row, dims: Sequence[str]) -> Words:
    value = with_error(row["correlation_dimension"], row["correlation_dimension_stderr"])
    stays = f"{row['n_left']} of {row['n_sampled']} left"
    if not row["n_left"] and np.isfinite(row["lifetime_low"]):
        stays = f"stays, lifetime above {row['lifetime_low']:.0f} periods"
    ends = f"{row['fit_low']:.3g} to {row['fit_high']:.3g}" if np.isfinite(row["fit_low"]) else "-"
    return {
        **at_point(ds, row, dims),
        "id": str(row["attractor_id"]),
        "cells": str(row["n_cells"]),
        "extended": stays,
        "points": str(row["n_points"]),
        "dimension": _WHY.get(row["reason"], value),
        "fitted radii": ends,
        "lower minus upper half": number(row["correlation_dimension_spread"], "+.2f"),
        "resolvable": number(row["largest_resolved"], ".1f"),
    }


def chaos_of(ds: xr.Dataset, attractors: xr.Dataset, options: ChaosOptions | None = None, **changes: Any) -> xr.Dataset:
    """Compute the indicators of chaos for each cell (trajectory) and for each attractor.

    Parameters
    ----------
    ds
        Cube with `section` and `status`, and optionally the variables of the product `lyapunov`.
    attractors
        Result of `identify` or `match` for the cube.
    options
        By default the defaults of `ChaosOptions`.
    changes
        Fields of `ChaosOptions`, used if `options` is None.

    Returns
    -------
    Dataset
        In memory: the variables of `chaotic_cells`, the cells' `attractor_id`, and those of
        `pipeline.analysis.chaos.per_attractor`.

    Raises
    ------
    ValueError
        If an option is out of bounds, the cube has neither exponents nor enough sections and orbits are not
        polished, or `attractors` belong to another cube.
    """
    options = options or ChaosOptions(**changes)
    if attractors["attractor_id"].sizes != ds["status"].sizes:
        raise ValueError("attractors and ds have other cells; give what identify made of this cube.")
    if len(missing := reasons(ds, options.stride)) == 2 and not attractors.attrs.get("identify_polish", 1):
        raise ValueError("nothing to compute. " + ". ".join(missing))
    cells = chaotic_cells(ds, options)
    cells["attractor_id"] = attractors["attractor_id"].transpose(*cells["motion"].dims)
    found = chaos_per_attractor(ds, cells, attractors, options)
    return found.assign_attrs(cells.attrs)


def chaotic_cells(ds: xr.Dataset, options: ChaosOptions | None = None, **changes: Any) -> xr.Dataset:
    """Compute the indicators of chaos for each cell (trajectory): Lyapunov exponents, dimension, 0-1 test.

    Parameters
    ----------
    ds, options, changes
        Cube and options, see `chaos_of`.

    Returns
    -------
    Dataset
        In memory, on the dims of the cells: `status`, `motion`, `contradicts`, `is_transient` and, as far as
        the cube allows,

        ``lyapunov``, ``lyapunov_stderr`` (exponent) [1/s], ``lyapunov_per_period``,
        ``lyapunov_per_period_stderr`` (exponent) [1], ``lyapunov_flag``, ``drift`` [1/s], ``drift_sigma``,
        ``audit`` [1/s]
            As in the cube and in `summarise`.
        ``kaplan_yorke_dimension``, ``kaplan_yorke_dimension_stderr``
            Dimension of the section and its standard error, see `kaplan_yorke_dimension`.
        ``zero_one``, ``zero_one_stderr``, ``zero_one_half``, ``zero_one_low``, ``zero_one_high``,
        ``oversampling``
            See `zero_one_test`.

        The attribute ``not_computed`` has a line for each indicator that the cube does not allow.

    Raises
    ------
    ValueError
        If an option is out of bounds.
    """
    options = options or ChaosOptions(**changes)
    missing = reasons(ds, options.stride)
    cells = _of_exponents(ds, options) if "lyapunov" in ds else _without_exponents(ds)
    if not any(reason.startswith("0-1") for reason in missing):
        found = zero_one_test(ds, n_frequencies=options.n_frequencies, stride=options.stride, seed=options.seed)
        cells = cells.assign(found.data_vars)
    cells = cells.assign(status=ds["status"]).drop_attrs(deep=False).load()
    coords = {name: c for name, c in ds.coords.items() if set(c.dims) <= set(cells["motion"].dims)}
    return cells.assign_coords(coords).assign_attrs(
        ds.attrs, chaos_n_sigma=options.n_sigma, chaos_least=options.least, not_computed="\n".join(missing)
    )


def reasons(ds: xr.Dataset, stride: int = 1) -> list[str]:
    """Return the reasons why Lyapunov exponents or the 0-1 test cannot be computed from a result cube, one sentence
    each.
    """
    found = []
    if "lyapunov" not in ds:
        found.append(
            "Lyapunov exponents of what does not close: the cube has none; run it with [products] "
            "lyapunov = {} in its specification"
        )
    n = -(-ds.sizes["period_index"] // stride)
    if n < FEWEST_SECTIONS:
        every = f" at every {stride}th period" if stride > 1 else ""
        found.append(f"0-1 test: {n} sections{every}, and it needs {FEWEST_SECTIONS}; raise n_keep")
    return found


def _of_exponents(ds: xr.Dataset, options: ChaosOptions) -> xr.Dataset:
    summary = summarise(ds, n_sigma=options.n_sigma, least=options.least).drop_vars("lyapunov_running")
    own = ds[["lyapunov", "lyapunov_stderr", "lyapunov_flag"]]
    dimension = kaplan_yorke_dimension(ds, flow="return_time" in ds)
    return own.assign(summary.data_vars).assign(dimension.data_vars)


def _without_exponents(ds: xr.Dataset) -> xr.Dataset:
    closed = is_closed(ds)
    motion = xr.full_like(closed, CellMotion.UNKNOWN, dtype=np.int8)
    motion = motion.where(~closed, np.int8(CellMotion.REGULAR)).assign_attrs(motion_attrs())
    return xr.Dataset(
        {
            "motion": motion,
            "contradicts": xr.zeros_like(motion, np.int8).drop_attrs(),
            "is_transient": xr.full_like(motion, -1).drop_attrs(),
        }
    )


def section_dimension(
    ds: xr.Dataset, attractors: xr.Dataset, options: DimensionOptions | None = None, **changes: Any
) -> xr.Dataset:
    """Compute the correlation dimension of each non-periodic attractor from the section points of its cells.

    A cell that is still closing and a chaotic transient fill no set, so the slope of their correlation sum is
    no dimension. Only sets that were shown to attract have a dimension.

    Parameters
    ----------
    ds
        Cube with `section`, `status` and `orbit_period`.
    attractors
        Result of `identify` or `match` for the cube.
    options
        By default the defaults of `DimensionOptions`; `at` selects values of swept parameters.
    changes
        Fields of `DimensionOptions`, used if `options` is None.

    Returns
    -------
    Dataset
        Rows of sets, see `pipeline.results.ragged`: the variables of
        `pipeline.analysis.chaos.dimensions.correlation_dimension`; `n_cells`, `share`, `kind`; `reason`, the
        reason why there is no dimension (`REASONS`); `stability`, `n_sampled`, `n_left`, `lifetime_low` of
        `identify`.

    Raises
    ------
    ValueError
        If the cube lacks an axis or a value, an option is out of bounds, or `attractors` belong to another
        cube.
    """
    options = options or DimensionOptions(**changes)
    part = select_points(ds, options.at)
    whole = select_points(attractors, options.at)
    _, starts = split_dims(part["status"])
    found = whole[[ROW_SIZE, "n_cells", "share", "kind", "stability", "n_sampled", "n_left", "lifetime_low"]]
    ids = whole["attractor_id"].transpose(*dims_of(found), *starts).values
    section = part[["section", "status"]].load().assign_attrs(ds.attrs)
    kind, stability = found["kind"].values, found["stability"].values
    stays = np.isin(kind, APERIODIC) & (stability == ATTRACTS)

    def curve(index: tuple[int, ...], own: np.ndarray) -> xr.Dataset:
        point = section.isel(dict(zip(dims_of(found), index, strict=True)))
        return correlation_dimension(
            pooled(point, starts, own),
            pool=["cell"],
            theiler=options.theiler,
            n_max=options.n_max,
            floor=options.floor,
            geometry=geometry_of(ds),
        )

    nothing = curve((0,) * len(dims_of(found)), np.zeros(1, bool))
    curves = [nothing] * found.sizes[SET]
    for index, rows in rows_at(found).items():
        for row in rows:
            if stays[row]:
                curves[row] = curve(index, ids[index].ravel() == found["attractor"].values[row])
    reason = [
        _reason(*one) for one in zip(kind, stays, (c["correlation_dimension"].item() for c in curves), strict=True)
    ]
    result = found.assign(_stacked(curves, nothing)).assign(
        reason=(SET, np.array(reason, np.int8), code_flags(REASONS))
    )
    plain = {f"dimension_{k}": getattr(options, k) for k in ("theiler", "n_max", "floor")}
    return result.drop_attrs(deep=False).assign_attrs({**ds.attrs, **plain, N_IDS: found.attrs[N_IDS]})


def _reason(kind: int, stays: bool, dimension: float) -> int:
    if kind not in APERIODIC:
        return CLOSED
    if not stays:
        return NO_ATTRACTOR
    return HAS_DIMENSION if np.isfinite(dimension) else TOO_FEW


def _stacked(curves: Sequence[xr.Dataset], schema: xr.Dataset) -> dict[str, Any]:
    """Return the variables of some curves on the rows; there may be no row."""
    return {
        str(name): ((SET, *one.dims), np.stack([c[name].values for c in (schema, *curves)])[1:], one.attrs)
        for name, one in schema.data_vars.items()
    }
