"""Chaos of a cube's cells: Lyapunov exponents, Kaplan-Yorke dimension, 0-1 test; means by kind of motion.

    ds = pipeline.open_run(directory)
    found = chaos(ds)                       # or pipeline.products.derived.chaos(directory), which keeps it
    found.mean_lyapunov.sel(kind="chaotic")

Nothing is integrated. A mean over cells is a statement about one attractor only where the cells of that
kind share one (or mirror images); `mean_lyapunov_between` says how far they differ beyond their errors. Cells
of one attractor whose second exponent is small fall on either side of the limit between chaotic and
hyperchaotic; a mean over one of the two kinds is then biased by the choice, that over both is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from pipeline.analysis.chaos.indicators import (
    FLOOR,
    SHORTEST,
    correlation_dimension,
    kaplan_yorke_dimension,
    zero_one_test,
)
from pipeline.analysis.chaos.lyapunov import Motion, pooled_mean, summarise
from pipeline.analysis.selection import select_points
from pipeline.layout.vocabulary import BOUNDED, PERIODIC, split_dims
from pipeline.products.lyapunov import LyapunovFlag

Floats = npt.NDArray[np.float64]

_MOTIONS = tuple(Motion)
_GROUPS = {**{m.name.lower(): (m,) for m in _MOTIONS}, "all_chaotic": (Motion.CHAOTIC, Motion.HYPERCHAOTIC)}
KINDS = tuple(_GROUPS)
"""Coordinate `kind`: names of `Motion`, and chaotic or hyperchaotic together."""

FEWEST_BLOCKS = 12
"""Blocks from which a transient can be told: three in each quarter, so that they have errors."""


def chaos(
    ds: xr.Dataset, *, n_sigma: float = 3.0, least: float = 0.005, n_frequencies: int = 100,
    stride: int = 1, seed: int = 0,
) -> xr.Dataset:  # fmt: skip
    """Chaos of each cell, and counts and means by kind of motion at each parameter point.

    Parameters
    ----------
    ds
        Cube with `section` and `status`; with `lyapunov` and the variables beside it if it has them.
    n_sigma, least
        Standard errors by which, and least modulus [1/s] at which, an exponent differs from 0; see
        `pipeline.analysis.chaos.lyapunov.summarise`.
    n_frequencies, stride, seed
        Of the 0-1 test, see `pipeline.analysis.chaos.indicators.zero_one_test`.

    Returns
    -------
    Dataset
        In memory. On the dims of the cells: `status`, `motion` and, as far as the cube allows,

        ``lyapunov``, ``lyapunov_stderr`` (exponent) [1/s], ``lyapunov_per_period``,
        ``lyapunov_per_period_stderr`` (exponent) [1], ``lyapunov_flag``, ``drift`` [1/s], ``drift_sigma``,
        ``audit`` [1/s]
            As in the cube and in `summarise`.
        ``is_transient``
            1 if the motion was chaotic and is not any more: the mean of the largest exponent is above
            `least` over the first quarter of the blocks, below ``-least`` over the last, and the two differ
            by `n_sigma` standard errors. 0 if not, or if the chaos ended in the last quarter or early in the
            first; -1 if unknown (no exponents, or fewer than 12 blocks).
        ``kaplan_yorke_dimension``, ``kaplan_yorke_dimension_stderr``
            Of the section, see `kaplan_yorke_dimension`.
        ``zero_one``, ``zero_one_stderr``, ``zero_one_half``, ``zero_one_low``, ``zero_one_high``,
        ``oversampling``
            See `zero_one_test`.

        On the swept parameters and ``kind``, a kind of motion (``all_chaotic``: chaotic or hyperchaotic):

        ``n_cells``, ``n_transient``, ``n_drifting``, ``n_audit_failed``, ``n_unresolved``, ``n_failed``
            Cells; of those: with `is_transient` 1; not closed, with a drift beyond `n_sigma` standard
            errors either way; with these flags.
        ``mean_lyapunov``, ``mean_lyapunov_stderr``, ``mean_lyapunov_between`` (exponent) [1/s]
            Mean over the cells, its standard error, and the standard deviation between cells that their
            own errors do not explain. Exponents after the first: of cells flagged good.
        ``mean_lyapunov_per_period``, ``mean_lyapunov_per_period_stderr`` (exponent) [1]
            The same over the frequency.
        ``mean_kaplan_yorke``, ``mean_kaplan_yorke_stderr``
            Mean over the cells with a dimension, with its standard error.
        ``median_zero_one``, ``least_zero_one``, ``largest_zero_one``
            Median and range of K over the cells.

        The attribute ``not_computed`` has a line for each indicator that the cube does not allow.

    Raises
    ------
    ValueError
        If an option is out of bounds, or the cube has neither exponents nor sections enough.

    Notes
    -----
    How errors within and between cells combine is said in `pipeline.analysis.chaos.lyapunov.pooled_mean`.
    """
    check_chaos(ds, n_sigma=n_sigma, least=least, n_frequencies=n_frequencies, stride=stride, seed=seed)
    missing = reasons(ds, stride)
    cells = _of_exponents(ds, n_sigma, least) if "lyapunov" in ds else _without_exponents(ds)
    if not any(reason.startswith("0-1") for reason in missing):
        found = zero_one_test(ds, n_frequencies=n_frequencies, stride=stride, seed=seed)
        cells = cells.assign(found.data_vars)
    cells = cells.assign(status=ds["status"]).drop_attrs(deep=False).load()
    points = _by_kind(cells, n_sigma)
    coords = {name: c for name, c in ds.coords.items() if set(c.dims) <= set(cells["motion"].dims)}
    return cells.assign(points.data_vars).assign_coords(coords).assign_attrs(
        ds.attrs, chaos_n_sigma=n_sigma, chaos_least=least, not_computed="\n".join(missing),
    )  # fmt: skip


def check_chaos(
    ds: xr.Dataset, *, n_sigma: float, least: float, n_frequencies: int, stride: int, seed: int = 0
) -> None:
    """Refuse options of `chaos` that are out of bounds, and a cube that has nothing to say.

    Raises
    ------
    ValueError
        Naming all that is wrong.
    """
    bounds = (
        ("least", least, 0),
        ("n_frequencies", n_frequencies, 10),
        ("stride", stride, 1),
        ("seed", seed, 0),
    )
    problems = [
        f"{name} = {value:g} is out of bounds: it must be {low} or more."
        for name, value, low in bounds
        if not value >= low
    ]
    if not n_sigma > 0:
        problems.append(f"n_sigma = {n_sigma:g} is out of bounds: it must be greater than 0.")
    if problems:
        raise ValueError(" ".join(problems))
    if len(missing := reasons(ds, stride)) == 2:
        raise ValueError("nothing to compute. " + ". ".join(missing))


def reasons(ds: xr.Dataset, stride: int = 1) -> list[str]:
    """Why the exponents or the 0-1 test are not to be had from a cube; a sentence each."""
    found = []
    if "lyapunov" not in ds:
        found.append(
            "Lyapunov exponents: the cube has none; run it with [products] lyapunov = {} in its specification"
        )
    n = -(-ds.sizes["period_index"] // stride)
    if n < SHORTEST:
        every = f" at every {stride}th period" if stride > 1 else ""
        found.append(f"0-1 test: {n} sections{every}, and it needs {SHORTEST}; raise n_keep")
    return found


def _of_exponents(ds: xr.Dataset, n_sigma: float, least: float) -> xr.Dataset:
    summary = summarise(ds, n_sigma=n_sigma, least=least).drop_vars("lyapunov_running")
    own = ds[["lyapunov", "lyapunov_stderr", "lyapunov_flag"]]
    cells = own.assign(summary.data_vars).assign(kaplan_yorke_dimension(ds).data_vars)
    known = cells["motion"] != Motion.UNKNOWN
    return cells.assign(is_transient=_is_transient(ds["lyapunov_blocks"], known, n_sigma, least))


def _without_exponents(ds: xr.Dataset) -> xr.Dataset:
    """Closed orbits are regular; nothing is known of the others."""
    closed = (ds["status"] == PERIODIC) | (ds["orbit_period"] > 0)
    motion = xr.full_like(closed, Motion.UNKNOWN, dtype=np.int8)
    motion = motion.where(~closed, np.int8(Motion.REGULAR)).assign_attrs(_motion_attrs())
    return xr.Dataset({"motion": motion, "is_transient": xr.full_like(motion, -1)})


def _motion_attrs() -> dict[str, Any]:
    return {
        "units": "1", "long_name": "kind of motion", "flag_values": np.array(_MOTIONS, np.int8),
        "flag_meanings": " ".join(m.name.lower() for m in _MOTIONS),
    }  # fmt: skip


def _is_transient(blocks: xr.DataArray, known: xr.DataArray, n_sigma: float, least: float) -> xr.DataArray:
    first = blocks.isel(exponent=0, drop=True)
    attrs = {
        "units": "1", "long_name": "the chaos ended within the blocks", "flag_values": [-1, 0, 1],
        "flag_meanings": "unknown no yes",
    }  # fmt: skip
    quarter = first.sizes["block"] // 4
    if first.sizes["block"] < FEWEST_BLOCKS:
        return xr.full_like(known, -1, dtype=np.int8).assign_attrs(attrs)
    early, late = first.isel(block=slice(quarter)), first.isel(block=slice(-quarter, None))
    before, after = early.mean("block"), late.mean("block")
    error = np.sqrt((early.var("block", ddof=1) + late.var("block", ddof=1)) / quarter)
    # not each by its own error: the blocks of an orbit with complex multipliers swing widely
    ended = (before > least) & (after < -least) & (before - after > n_sigma * error)
    return ended.astype(np.int8).where(known, np.int8(-1)).assign_attrs(attrs)


# ---- means by kind of motion -------------------------------------------------------------------


def _by_kind(cells: xr.Dataset, n_sigma: float) -> xr.Dataset:
    """Counts and means over the cells of each kind, at each parameter point."""
    dims, starts = split_dims(cells["motion"])

    def table(name: str) -> Floats:
        """Values with the cells of a point on the last axis, exponents before it."""
        array = cells[name]
        own = [d for d in array.dims if d not in (*dims, *starts)]
        values = array.transpose(*dims, *own, *starts).values
        return np.asarray(values.reshape(*values.shape[: len(dims) + len(own)], -1))

    is_kind = np.stack([np.isin(table("motion"), codes) for codes in _GROUPS.values()], axis=len(dims))
    variables: dict[str, Any] = {}

    def put(name: str, values: Any, text: str, units: str = "1", own: Sequence[str] = ()) -> None:
        variables[name] = ([*dims, "kind", *own], values, {"units": units, "long_name": text})

    def count(name: str, which: Any, text: str) -> None:
        put(name, (is_kind & np.expand_dims(which, len(dims))).sum(-1), text)

    count("n_cells", np.array([True]), "cells")
    count("n_transient", table("is_transient") == 1, "cells whose chaos ended")
    if "lyapunov" in cells:
        flag = table("lyapunov_flag")
        # the blocks of a closed orbit scatter by its waves, not by chance
        drifting = (np.abs(table("drift_sigma")) > n_sigma) & (table("status") != PERIODIC)
        count("n_drifting", drifting, "cells whose largest exponent drifts")
        for code in (LyapunovFlag.AUDIT_FAILED, LyapunovFlag.UNRESOLVED, LyapunovFlag.FAILED):
            count(f"n_{code.name.lower()}", flag == code, f"cells flagged: {code.sentence}")
        _put_exponents(cells, table, is_kind, put)
        value, error = (_beside(table(f"kaplan_yorke_dimension{end}"), dims) for end in ("", "_stderr"))
        mean, stderr, _ = pooled_mean(value, error, is_kind)
        put("mean_kaplan_yorke", mean, "mean Kaplan-Yorke dimension of the section")
        put("mean_kaplan_yorke_stderr", stderr, "its standard error")
    if "zero_one" in cells:
        k = np.where(is_kind, _beside(table("zero_one"), dims), np.nan)
        for name, q in (("median", 0.5), ("least", 0.0), ("largest", 1.0)):
            put(f"{name}_zero_one", _quantile(k, q), f"0-1 test, {name} over the cells")
    return xr.Dataset(variables, coords={"kind": ("kind", list(KINDS), {"long_name": "kind of motion"})})


def _put_exponents(cells: xr.Dataset, table: Any, is_kind: npt.NDArray[np.bool_], put: Any) -> None:
    """Means of the exponents, per unit time and per drive period."""
    good = table("lyapunov_flag") == LyapunovFlag.GOOD
    for name, units, per in (("lyapunov", "1/s", "unit time"), ("lyapunov_per_period", "1", "drive period")):
        value, error = table(name), table(f"{name}_stderr")
        columns = []
        for k in range(value.shape[-2]):
            usable = is_kind & np.expand_dims(good, -2) if k else is_kind
            columns.append(pooled_mean(value[..., k : k + 1, :], error[..., k : k + 1, :], usable))
        mean, stderr, between = (np.stack(part, axis=-1) for part in zip(*columns, strict=True))
        put(f"mean_{name}", mean, f"mean exponents per {per}", units, ["exponent"])
        put(f"mean_{name}_stderr", stderr, "their standard errors", units, ["exponent"])
        if units == "1/s":
            text = "standard deviation between cells beyond their errors"
            put(f"mean_{name}_between", between, text, units, ["exponent"])


def _beside(values: Floats, dims: Sequence[str]) -> Floats:
    """With an axis for the kinds."""
    return np.expand_dims(values, len(dims))


def _quantile(values: Floats, q: float) -> Floats:
    """Quantile over the last axis of what is finite, NaN where nothing is."""
    flat = values.reshape(-1, values.shape[-1])
    found = [np.quantile(row[np.isfinite(row)], q) if np.isfinite(row).any() else np.nan for row in flat]
    return np.asarray(found, np.float64).reshape(values.shape[:-1])


# ---- correlation dimension of the chaos of a parameter point ------------------------------------


def section_dimension(
    ds: xr.Dataset, *, at: Mapping[str, float] | None = None, theiler: int = 1, n_max: int = 10_000,
    floor: float = FLOOR,
) -> xr.Dataset:  # fmt: skip
    """Correlation dimension of the pooled sections of the chaotic cells of each parameter point.

    Parameters
    ----------
    ds
        Cube with `section`, `status` and `orbit_period`. Chaotic are, if it has exponents, the cells
        that `chaos` calls chaotic or hyperchaotic and no transients; otherwise those that do not close.
    at
        Values of swept parameters; all points of the others are taken.
    theiler, n_max, floor
        See `pipeline.analysis.chaos.indicators.correlation_dimension`.

    Returns
    -------
    Dataset
        Of `correlation_dimension`, on the swept parameters, and ``n_cells``, the cells pooled. Cells on
        several attractors show the largest of their dimensions, if the points of that one are not few.

    Raises
    ------
    ValueError
        If an axis or a value is not the cube's, or an option is out of bounds.
    """
    check_dimension(ds, at=at, theiler=theiler, n_max=n_max, floor=floor)
    part = select_points(ds, at)
    _, starts = split_dims(part["status"])
    own = part[["section", "status"]].load()
    is_chaotic = _is_chaotic(part)
    own["section"] = own["section"].where(is_chaotic)
    found = correlation_dimension(own, pool=starts, theiler=theiler, n_max=n_max, floor=floor)
    n_cells = is_chaotic.sum(starts).assign_attrs(units="1", long_name="cells pooled")
    return found.assign(n_cells=n_cells).assign_attrs(ds.attrs)


def check_dimension(
    ds: xr.Dataset, *, at: Mapping[str, float] | None, theiler: int, n_max: int, floor: float
) -> None:
    """Refuse options of `section_dimension` that are out of bounds.

    Raises
    ------
    ValueError
        Naming all that is wrong, or the first axis or value that is not the cube's.
    """
    problems = [
        f"{name} = {value} is out of bounds: it must be {low} or more."
        for name, value, low in (("theiler", theiler, 0), ("n_max", n_max, 100))
        if value < low
    ]
    if not floor > 0:
        problems.append(f"floor = {floor:g} is out of bounds: it must be greater than 0.")
    if problems:
        raise ValueError(" ".join(problems))
    select_points(ds, at)


def _is_chaotic(ds: xr.Dataset) -> xr.DataArray:
    if "lyapunov" not in ds:
        return (ds["status"] == BOUNDED) & (ds["orbit_period"] == 0)
    cells = _of_exponents(ds, 3.0, 0.005)
    return cells["motion"].isin((Motion.CHAOTIC, Motion.HYPERCHAOTIC)) & (cells["is_transient"] != 1)
