"""Classify the motion of a run's cells by the model's classifier.

The model defines the labels, the rule and its evidence (`magpend_core.models.model.Classifier`). This module
applies the rule with the parameters of the run, swept parameters included.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from magpend_core.models.model import Classifier, Parameters
from pipeline.layout.conventions import code_flags
from pipeline.layout.own_words import hertz_of
from pipeline.layout.vocabulary import BOUNDED, INFERRED, PERIODIC, model_of, parameters_of

UNKNOWN = 0
"""Code of every classifier's first label: the motion is unknown."""

_COMPUTED = (PERIODIC, BOUNDED, INFERRED)


def classify(ds: xr.Dataset, *, parameters: Parameters | None = None) -> xr.DataArray | None:
    """Return the class of motion (a code) of each cell by the model's classifier; the array is lazy if `ds` is.

    Parameters
    ----------
    ds
        Cube with `section` and `status`, and `turns` if the model has angles; without `turns` nothing
        counts as turning. The drive frequency [Hz] is the coordinate ``frequency``, else the attribute
        ``frequency_hz``, else infinite. Coordinates named like parameters replace those of the run.
    parameters
        Parameters of the run, by default from the attributes.

    Returns
    -------
    DataArray of int8, or None
        Codes of the classifier's labels on the dims of ``status``, with the attributes ``flag_values`` and
        ``flag_meanings``; 0 (unknown) for cells that were not computed. None if the model has no classifier.

    Raises
    ------
    ValueError
        If the run's parameters are missing.
    """
    model = model_of(ds) if parameters is None else parameters.model
    if model.classifier is None:
        return None
    values = parameters_of(ds) if parameters is None else parameters
    swept = [name for name in values if name in ds.coords]
    names = [name for name in values if name not in swept]
    inputs = [ds["section"], ds["status"], _frequency(ds), *(ds.coords[name] for name in swept)]
    cores: list[list[str]] = [["period_index", "state"], *([] for _ in inputs[1:])]
    if "turns" in ds:
        inputs.append(ds["turns"])
        cores.append([str(d) for d in ds["turns"].dims if d not in ds["status"].dims])
    label: xr.DataArray = xr.apply_ufunc(
        _label,
        *inputs,
        input_core_dims=cores,
        dask="parallelized",
        output_dtypes=[np.int8],
        dask_gufunc_kwargs={"allow_rechunk": True},
        kwargs={
            "classifier": model.classifier,
            "fixed": {name: values[name] for name in names},
            "swept": swept,
            "n_angles": len(model.angles),
        },
    )
    label = label.transpose(*ds["status"].dims)
    return label.rename("side").assign_attrs(flags_of(model.classifier))


def flags_of(classifier: Classifier) -> dict[str, Any]:
    """Return the xarray attributes of an array of classifier codes: unit, name, flag values and meanings."""
    return {"units": "1", "long_name": classifier.meaning, **code_flags(classifier.words)}


def _frequency(ds: xr.Dataset) -> xr.DataArray:
    found = hertz_of(ds)
    return xr.DataArray(float(ds.attrs.get("frequency_hz", np.inf))) if found is None else found


def _label(
    section: np.ndarray,
    status: np.ndarray,
    frequency: np.ndarray,
    *rest: np.ndarray,
    classifier: Classifier,
    fixed: Mapping[str, float],
    swept: list[str],
    n_angles: int,
) -> np.ndarray:
    """Return the class of motion (a code) of each cell of a block, from its section points (..., period, state)."""
    values = {**fixed, **dict(zip(swept, rest, strict=False))}
    turns = rest[len(swept)] if len(rest) > len(swept) else np.zeros((1,) * status.ndim + (n_angles,), int)
    known = np.isfinite(section).all(axis=(-2, -1)) & np.isin(status, _COMPUTED)
    code = classifier.classify(np.nan_to_num(section), turns, frequency, values)
    return np.where(known, code, np.int8(UNKNOWN)).astype(np.int8)
