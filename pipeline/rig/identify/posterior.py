"""Draw parameter sets from the Gaussian posterior of an identification."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models import load_model
from magpend_core.models.model import Model
from pipeline.products.product import Table
from pipeline.rig.identify.directory import read_info, read_result
from pipeline.specification.problems import SpecError

LEAST_SHARE = 0.01
"""Least share of the draws that must lie within the bounds."""

LEVELS = (0.025, 0.5, 0.975)
"""Quantiles that are reported: the median and the ends of the 95 % interval."""


def draw_posterior(directory: str | Path, n: int, seed: int = 1) -> xr.Dataset:
    """Draw parameter sets from the Gaussian that the estimates and their covariance define, truncated to the bounds.

    Parameters
    ----------
    directory
        Directory of a finished identification.
    n
        Number of draws.
    seed
        Seed; the same one gives the same draws.

    Returns
    -------
    Dataset
        ``value`` over (draw, parameter): all parameters of the model, identified, tied and fixed [SI]. Attributes
        ``identified`` (names), ``digest``, ``seed``, and ``outside``: the share of draws that the bounds rejected.

    Raises
    ------
    SpecError
        For parameters that are not determined, and if almost all draws lie outside the bounds.
    RefusedError
        If the identification is not finished.
    """
    info, result = read_info(directory), read_result(directory)
    names = [name for name in result["names"] if name in result["values"]]
    rows = [result["names"].index(name) for name in names]
    matrix = np.array(result["covariance"]["matrix"], dtype=float)[np.ix_(rows, rows)]
    _refuse_undetermined(names, matrix)
    drawn, outside = _within_bounds(result, names, matrix, n, seed)
    model: Model = load_model(result["model"])
    values = np.tile([result["values"][name] for name in model.parameter_names], (n, 1))
    columns = list(model.parameter_names)
    values[:, [columns.index(name) for name in names]] = drawn
    for name, (factor, other) in result["tied"].items():
        values[:, columns.index(name)] = factor * values[:, columns.index(other)]
    about = {"identified": " ".join(names), "digest": info.digest, "seed": seed, "outside": outside}
    return xr.Dataset({"value": (("draw", "parameter"), values)}, {"parameter": columns}, about)


def _refuse_undetermined(names: list[str], matrix: np.ndarray) -> None:
    lost = [name for name, variance in zip(names, np.diag(matrix), strict=True) if not np.isfinite(variance)]
    if lost:
        raise SpecError(
            [
                f"{', '.join(lost)}: the data do not determine it, so it has no posterior; fix it under "
                "[parameters], or give it a prior, and identify again."
            ]
        )


def _within_bounds(
    result: dict[str, Any], names: list[str], matrix: np.ndarray, n: int, seed: int
) -> tuple[np.ndarray, float]:
    """Draw from the Gaussian until `n` draws lie within the bounds; return them and the fraction that was rejected."""
    estimates = [result["estimates"][name] for name in names]
    mean = np.array([e["value"] for e in estimates])
    low = np.array([-np.inf if e["bounds"][0] is None else e["bounds"][0] for e in estimates])
    high = np.array([np.inf if e["bounds"][1] is None else e["bounds"][1] for e in estimates])
    scale = np.sqrt(np.diag(matrix))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    random, kept, tried = np.random.default_rng(seed), np.zeros((0, len(names))), 0
    while len(kept) < n:
        if tried and len(kept) < LEAST_SHARE * tried:
            raise SpecError(
                [
                    f"only {len(kept)} of {tried} draws lie within the bounds: the estimates' errors are larger than "
                    "the bounds allow; widen the bounds, give priors, or identify fewer parameters."
                ]
            )
        batch = mean + random.standard_normal((max(4 * n, 1000), len(names))) @ root.T * scale
        tried += len(batch)
        kept = np.vstack([kept, batch[((batch >= low) & (batch <= high)).all(axis=1)]])
    return kept[:n], 1.0 - len(kept) / tried


def posterior_table(drawn: xr.Dataset) -> Table:
    """Return a table of the identified parameters: mean, standard deviation and 95 % interval over the draws."""
    rows, lines = [], []
    names = str(drawn.attrs["identified"]).split()
    width = max(map(len, names))
    for name in names:
        values = drawn["value"].sel(parameter=name).values
        low, middle, high = np.quantile(values, LEVELS)
        rows.append(
            {"name": name, "mean": values.mean(), "sd": values.std(ddof=1), "median": middle, "low": low, "high": high}
        )
        lines.append(f"{name:{width}} = {middle:.6g}   95 %: {low:.6g} to {high:.6g}")
    outside = 100.0 * float(drawn.attrs["outside"])
    lines.append(f"{drawn.sizes['draw']} draws of a Gaussian; {outside:.2g} % lay outside the bounds and were left out")
    return Table(rows, lines)
