"""Compute the indicators of chaos for each attractor at each parameter point.

Schema
------
Rows of sets on the dim ``set``, as in `pipeline.analysis.attractors.attractors` and in the same order; ``rank``, as
many as there are states; ``multiplier``. Variables, beside the copies of ``kind``, ``orbit_period``,
``n_cells``, ``share``, ``multiplier_real``, ``multiplier_imag``, ``stability``, ``evidence``:

`pipeline.analysis.chaos.declaration` lists the variables.

A polished orbit's exponents are the logarithms of its Floquet multipliers over its period. They are complete
and free of sampling errors, whether the cube has exponents or not. A bounded set's exponents are means over
its cells (`pooled_mean`), without transients; all but the first use only cells flagged good. `lyapunov_max`
of the attractors is the first exponent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from magpend_core.orbits import orbit_exponents
from pipeline.analysis.chaos.declaration import ChaosOptions
from pipeline.analysis.chaos.dimensions import correlation_dimension, kaplan_yorke_dimension
from pipeline.analysis.chaos.lyapunov import GOOD, UNRESOLVED, pooled_mean
from pipeline.analysis.chaos.section_samples import Floats, geometry_of
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import (
    APERIODIC,
    CHAOTIC_SET,
    EQUILIBRIUM,
    PERIODIC,
    PERIODIC_ORBIT,
    TORUS,
    TRANSIENT,
    UNSTABLE,
    model_of,
    split_dims,
)
from pipeline.products.lyapunov import LyapunovFlag
from pipeline.results.ragged import N_IDS, ROW_SIZE, SET, dims_of, rows_at


class Nature(IntEnum):
    """Classes of the motion on attractors, decided by Lyapunov exponents or else by the 0-1 test."""

    UNKNOWN = 0
    REGULAR = 1
    UNDECIDED = 2
    CHAOTIC = 3
    HYPERCHAOTIC = 4
    CHAOTIC_BY_TEST = 5
    REGULAR_BY_TEST = 6
    TRANSIENT = 7
    QUASI_PERIODIC = 8

    @property
    def words(self) -> str:
        """Name of this class of motion in tables."""
        by_test = self.name.endswith("_BY_TEST")
        name = self.name.removesuffix("_BY_TEST").lower().replace("quasi_", "quasi-")
        return name + (" (by the 0-1 test)" if by_test else "")

    @property
    def has_dimension(self) -> bool:
        """Whether the correlation dimension is computed for attractors of this class."""
        return self in (Nature.CHAOTIC, Nature.HYPERCHAOTIC, Nature.CHAOTIC_BY_TEST, Nature.UNDECIDED)


_FROM = ("none", "multipliers", "cells", "eigenvalues")


@dataclass
class _Cells:
    """Variables of the cells of one parameter point, as arrays with the cells on the first axis."""

    values: dict[str, npt.NDArray[Any]]
    has_returns: bool

    @classmethod
    def of(cls, cells: xr.Dataset, starts: Sequence[str]) -> _Cells:
        values = {}
        for name, array in cells.data_vars.items():
            own = [d for d in array.dims if d not in starts]
            table = array.transpose(*starts, *own).values
            values[str(name)] = table.reshape(-1, *table.shape[len(starts) :])
        return cls(values, model_of(cells).crossing is not None)

    def get(self, name: str) -> npt.NDArray[Any] | None:
        return self.values.get(name)


def chaos_per_attractor(ds: xr.Dataset, cells: xr.Dataset, attractors: xr.Dataset, options: ChaosOptions) -> xr.Dataset:
    """Add the indicators of chaos per attractor to those of the cells; the docstring of this module lists the
    variables.

    Parameters
    ----------
    ds
        The cube.
    cells
        Result of `chaotic_cells`, with `attractor_id`.
    attractors
        Result of `identify` or `match`.
    options
        Criteria for the signs of exponents, and `n_max`, the most points of a correlation dimension.
    """
    _, starts = split_dims(cells["motion"])
    copied = [
        "kind",
        "stability",
        "evidence",
        "orbit_period",
        "n_cells",
        "share",
        "multiplier_real",
        "multiplier_imag",
        "period_s",
        "lyapunov_max",
        "lyapunov_low",
        "lyapunov_high",
    ]
    copied += [name for name in ("eigenvalue_real", "eigenvalue_imag") if name in attractors]
    own, n_states = attractors[[ROW_SIZE, *copied]].load(), ds.sizes["state"]
    arrays = {
        name: np.full((own.sizes[SET], *((n_states,) if rank else ())), fill, dtype)
        for name, (rank, dtype, fill) in _TABLE.items()
    }
    curves = _Curves(options)
    for index, rows in rows_at(own).items():
        at = dict(zip(dims_of(own), index, strict=True))
        here = _Cells.of(cells.isel(at), starts)
        for row in rows:
            number = int(own["attractor"].values[row])
            found = _of_attractor(own.isel({SET: row}), here, number, n_states, options)
            if found["kind_is_bounded"] and Nature(found["nature"]).has_dimension:
                found |= curves.of(ds.isel(at), starts, here, number)
            for name in arrays.keys() & found.keys():
                arrays[name][row] = found[name]
    variables = {name: ((SET, "rank")[: array.ndim], array) for name, array in arrays.items()}
    result = cells.assign(own.data_vars).assign(variables).assign_attrs({N_IDS: own.attrs[N_IDS]})
    result["nature"].attrs |= code_flags([nature.name.lower() for nature in Nature])
    result["exponents_from"].attrs |= code_flags(_FROM)
    return _with_kaplan_yorke(result.assign_coords(rank=np.arange(1, n_states + 1)))


def _of_attractor(one: xr.Dataset, cells: _Cells, number: int, n_states: int, options: ChaosOptions) -> dict[str, Any]:
    is_own = cells.values["attractor_id"] == number
    found: dict[str, Any] = {"kind_is_bounded": int(one["kind"]) in APERIODIC}
    found |= _counts(cells, is_own, options)
    found |= _exponents(one, cells, is_own, n_states)
    k = cells.get("zero_one")
    if k is not None and np.isfinite(k[is_own]).any():
        known = k[is_own][np.isfinite(k[is_own])]
        found |= {"median_zero_one": np.median(known), "least_zero_one": known.min(), "largest_zero_one": known.max()}
    found["nature"] = int(_nature(one, found, options))
    return found


def _counts(cells: _Cells, is_own: npt.NDArray[np.bool_], options: ChaosOptions) -> dict[str, int]:
    found = {
        "n_transient": int((cells.values["is_transient"][is_own] == 1).sum()),
        "n_contradicting": int((cells.values["contradicts"][is_own] == 1).sum()),
    }
    flag, drift = cells.get("lyapunov_flag"), cells.get("drift_sigma")
    if flag is None or drift is None:
        return found
    # the blocks of a closed orbit scatter because the orbit oscillates, not by chance
    open_cells = is_own & (cells.values["status"] != PERIODIC)
    found["n_drifting"] = int((np.abs(drift[open_cells]) > options.n_sigma).sum())
    for code in (LyapunovFlag.AUDIT_FAILED, LyapunovFlag.UNRESOLVED, LyapunovFlag.FAILED):
        found[f"n_{code.name.lower()}"] = int((flag[is_own] == code).sum())
    return found


def _exponents(one: xr.Dataset, cells: _Cells, is_own: npt.NDArray[np.bool_], n_states: int) -> dict[str, Any]:
    real, imaginary = one["multiplier_real"].values, one["multiplier_imag"].values
    if int(one["kind"]) == PERIODIC_ORBIT and np.isfinite(real).all():
        rate = orbit_exponents(real + 1j * imaginary, float(one["period_s"]), cells.has_returns)
        zero = np.zeros(n_states)
        return {
            "exponents_from": 1,
            "attractor_lyapunov": rate,
            "attractor_lyapunov_stderr": zero,
            "attractor_lyapunov_between": zero,
        }
    if int(one["kind"]) == EQUILIBRIUM:
        zero = np.zeros(n_states)
        return {
            "exponents_from": 3,
            "attractor_lyapunov": one["eigenvalue_real"].values,
            "attractor_lyapunov_stderr": zero,
            "attractor_lyapunov_between": zero,
        }
    rates, flag = cells.get("lyapunov"), cells.get("lyapunov_flag")
    if rates is None or flag is None:
        return {}
    lasting = is_own & (cells.values["is_transient"] != 1)
    good, first = lasting & (flag == GOOD), lasting & np.isin(flag, (GOOD, UNRESOLVED))
    if not first.any():
        return {}
    table = np.full((3, n_states), np.nan)
    for k in range(rates.shape[1]):
        which = good if k else first
        part = pooled_mean(rates[None, :, k], cells.values["lyapunov_stderr"][None, :, k], which[None])
        table[:, k] = [values[0] for values in part]
    names = ("attractor_lyapunov", "attractor_lyapunov_stderr", "attractor_lyapunov_between")
    return {"exponents_from": 2, **dict(zip(names, table, strict=True))}


def _nature(one: xr.Dataset, found: dict[str, Any], options: ChaosOptions) -> Nature:
    """Classify the motion on an attractor or other set by its kind and stability or, if these do not decide, by
    exponents or the 0-1 test.
    """
    # least median of K that shows chaos, and largest that shows order, by the 0-1 test alone
    chaotic, regular = 0.9, 0.1
    kind, stability = int(one["kind"]), int(one["stability"])
    if kind in (PERIODIC_ORBIT, EQUILIBRIUM):
        return Nature.UNDECIDED if stability == UNSTABLE else Nature.REGULAR
    if stability == TRANSIENT or found["n_transient"] == int(one["n_cells"]):
        return Nature.TRANSIENT
    if kind == TORUS:
        return Nature.QUASI_PERIODIC
    rate = found.get("attractor_lyapunov")
    if rate is not None and np.isfinite(rate[0]):
        margin = np.maximum(options.n_sigma * found["attractor_lyapunov_stderr"], options.least)
        if rate[0] > margin[0]:
            return Nature.HYPERCHAOTIC if len(rate) > 1 and rate[1] > margin[1] else Nature.CHAOTIC
        if kind != CHAOTIC_SET:
            return Nature.REGULAR if rate[0] < -margin[0] else Nature.UNDECIDED
    if kind == CHAOTIC_SET:
        return Nature.CHAOTIC
    k = found.get("median_zero_one")
    if k is None:
        return Nature.UNKNOWN
    if k >= chaotic:
        return Nature.CHAOTIC_BY_TEST
    return Nature.REGULAR_BY_TEST if k <= regular else Nature.UNDECIDED


class _Curves:
    """Correlation dimensions of attractors, from the pooled section points of their cells."""

    def __init__(self, options: ChaosOptions) -> None:
        self._n_max = options.n_max

    def of(self, point: xr.Dataset, starts: Sequence[str], cells: _Cells, number: int) -> dict[str, float]:
        """Compute the correlation dimension of one attractor from its cells; an empty dict if there are too few section
        points.
        """
        fewest = 1000  # section points for a correlation dimension: enough for a dimension of 1.2
        lasting = (cells.values["attractor_id"] == number) & (cells.values["is_transient"] != 1)
        n_keep = point.sizes["period_index"]
        if min(int(lasting.sum()) * n_keep, self._n_max) < fewest:
            return {}
        found = correlation_dimension(
            pooled(point, starts, lasting), pool=["cell"], n_max=self._n_max, geometry=geometry_of(point)
        )
        return {
            f"attractor_correlation{end}": float(found[f"correlation_dimension{end}"])
            for end in ("", "_stderr", "_spread")
        }


def pooled(point: xr.Dataset, starts: Sequence[str], which: npt.NDArray[np.bool_]) -> xr.Dataset:
    """Select some cells of a parameter point, and stack their section points and status on the dim ``cell``."""
    own = point[["section", "status"]].reset_coords(drop=True)
    rows = own.stack(cell=list(starts), create_index=False) if starts else own.expand_dims("cell")
    return rows.isel(cell=np.flatnonzero(which)).assign_attrs(point.attrs)


def _with_kaplan_yorke(result: xr.Dataset) -> xr.Dataset:
    exponents = {
        "attractor_lyapunov": result["attractor_lyapunov"],
        "attractor_lyapunov_stderr": result["attractor_lyapunov_stderr"],
    }
    spectra = xr.Dataset(exponents).reset_coords(drop=True)
    # spectra without some exponents keep NaN there, and have no dimension
    flow = model_of(result).crossing is not None
    found = kaplan_yorke_dimension(spectra, name="attractor_lyapunov", dim="rank", flow=flow)
    dims = result["nature"].dims
    return result.assign(
        attractor_kaplan_yorke=(dims, _values(found["kaplan_yorke_dimension"], dims)),
        attractor_kaplan_yorke_stderr=(dims, _values(found["kaplan_yorke_dimension_stderr"], dims)),
    )


def _values(array: xr.DataArray, dims: Sequence[Any]) -> Floats:
    return np.asarray(array.transpose(*dims).values)


_TABLE: dict[str, tuple[bool, str, float]] = {
    **dict.fromkeys(("nature", "exponents_from"), (False, "int8", 0)),
    **dict.fromkeys(
        ("n_transient", "n_drifting", "n_contradicting", "n_audit_failed", "n_unresolved", "n_failed"),
        (False, "int64", 0),
    ),
    **{f"attractor_lyapunov{end}": (True, "float64", np.nan) for end in ("", "_stderr", "_between")},
    **{f"attractor_correlation{end}": (False, "float64", np.nan) for end in ("", "_stderr", "_spread")},
    **dict.fromkeys(("median_zero_one", "least_zero_one", "largest_zero_one"), (False, "float64", np.nan)),
}
"""Whether on `rank`, dtype and fill of the variables per attractor."""
