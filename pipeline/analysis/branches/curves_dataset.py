"""Convert bifurcation curves and their points of codimension two into a labelled dataset."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from magpend_core.models.model import Model
from pipeline.analysis.branches.bifurcations import KINDS
from pipeline.analysis.branches.codimension_two import POINT_KINDS, merged
from pipeline.analysis.branches.curves import CURVE_ENDS, Curve
from pipeline.analysis.branches.units import parameter_units, state_units
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import model_attribute, section_attributes


def curves_dataset(curves: Sequence[Curve], first: str, second: str, model: Model | None = None) -> xr.Dataset:
    """Return bifurcation curves as a dataset with the dims ``curve``, ``point``, ``state`` and ``special`` (points of
    codimension two).

    ``special`` counts the points of codimension two: ``special_kind``, ``special_first`` and ``special_second``
    with their errors ``..._error``, ``special_period``, ``special_section`` and the curve on which each was found.

    Parameters
    ----------
    curves
        From `curves_from`; if there are none, so are the dataset's.
    first, second
        Names of the two parameters.
    model
        Tells names and units.
    """
    names = curves[0].family.system.state_names if curves else (model.state_names if model else ())
    n = max((len(c.points) for c in curves), default=0)
    values = np.full((len(curves), n, 2), np.nan)
    section = np.full((len(curves), n, len(names)), np.nan)
    residual = np.full((len(curves), n), np.nan)
    for i, curve in enumerate(curves):
        values[i, : len(curve.points)] = curve.values
        section[i, : len(curve.points)] = [curve.family.state(p.u) for p in curve.points]
        residual[i, : len(curve.points)] = [p.residual for p in curve.points]
    dims = ("curve", "point")
    one, units = {"units": "1"}, state_units(model)

    def codes(i: int) -> np.ndarray:
        return np.array([CURVE_ENDS.index(c.ends[i]) for c in curves], np.int8)

    def numbers(values: list[int]) -> np.ndarray:
        return np.array(values, np.int32)

    told = {} if model is None else {"model": model_attribute(model), **section_attributes(model.crossing)}
    return xr.Dataset(
        {
            "first": (dims, values[..., 0], {"units": parameter_units(first, model), "long_name": first}),
            "second": (dims, values[..., 1], {"units": parameter_units(second, model), "long_name": second}),
            "section": ((*dims, "state"), section, {"units": units, "long_name": "a section point"}),
            "residual": (dims, residual, {**one, "long_name": "largest residual, test function included"}),
            "kind": ("curve", np.array([KINDS.index(c.kind) for c in curves], np.int8), {**one, **code_flags(KINDS)}),
            "orbit_period": ("curve", numbers([c.family.period for c in curves]), one),
            "start": ("curve", numbers([c.start for c in curves]), {**one, "long_name": "located point"}),
            "n_missed": (
                "curve",
                numbers([c.n_missed for c in curves]),
                {**one, "long_name": "sign changes that could not be located"},
            ),
            "n_points": ("curve", numbers([len(c.points) for c in curves]), one),
            "first_end": ("curve", codes(0), {**one, **code_flags(CURVE_ENDS)}),
            "last_end": ("curve", codes(1), {**one, **code_flags(CURVE_ENDS)}),
            **_special_points(curves, first, second, model, len(names)),
        },
        coords={"state": list(names)},
        attrs={"first_parameter": first, "second_parameter": second, **told},
    )


def _special_points(
    curves: Sequence[Curve], first: str, second: str, model: Model | None, n_states: int
) -> dict[str, tuple[object, ...]]:
    """Return the points of codimension two on all curves as dataset variables, each point once."""
    found = merged({i: curve.special for i, curve in enumerate(curves)})
    values = np.array([one.values for one in found]).reshape(-1, 2)
    brackets = np.array([one.bracket for one in found]).reshape(-1, 2)
    section = np.array([one.family.state(one.point.u) for one in found]).reshape(-1, n_states)
    one, kinds = {"units": "1"}, code_flags(POINT_KINDS)
    variables: dict[str, tuple[object, ...]] = {
        "special_kind": ("special", np.array([POINT_KINDS.index(p.kind) for p in found], np.int8), {**one, **kinds}),
        "special_curve": ("special", np.array([p.curve for p in found], np.int32), one),
        "special_period": ("special", np.array([p.family.period for p in found], np.int32), one),
        "special_section": (("special", "state"), section, {"units": state_units(model)}),
    }
    for i, (role, name) in enumerate((("first", first), ("second", second))):
        units = {"units": parameter_units(name, model)}
        variables[f"special_{role}"] = ("special", values[:, i], {**units, "long_name": name})
        variables[f"special_{role}_error"] = ("special", brackets[:, i], {**units, "long_name": f"error of {name}"})
    return variables
