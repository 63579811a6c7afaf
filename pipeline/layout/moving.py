"""Compute the values that moving parameters have at the stored sections of a run."""

from __future__ import annotations

import numpy as np

from magpend_core.models.drift.ramps import Motion, Ramp, motion_of
from magpend_core.models.model import Model
from pipeline.layout.cells import Coordinate, ParameterAxis, parameter_axes
from pipeline.specification.spec import Spec
from pipeline.specification.tables import FREQUENCY


def at_section(parameter: str) -> str:
    """Return the name of the coordinate with a moving parameter's values at the sections."""
    return f"{parameter}_at_section"


def moving_coordinates(spec: Spec) -> list[Coordinate]:
    """Return for each moving parameter its values at the stored sections, as a coordinate of the cube.

    Its dims are the axes on which the parameter's motion depends, and the sections.
    """
    return [_coordinate(spec, ramp) for ramp in spec.ramps]


def motion_over(spec: Spec, ramp: Ramp) -> tuple[tuple[ParameterAxis, ...], Motion, np.ndarray]:
    """Return the axes on which a ramp depends, its motion at each of their points, and the drive's frequency there.

    The points are in the order of the axes, the last axis varying fastest.
    """
    named = {FREQUENCY, ramp.parameter, *ramp.names}
    axes = tuple(axis for axis in parameter_axes(spec) if axis.parameter in named)
    points = np.meshgrid(*(axis.values for axis in axes), indexing="ij")
    n = int(np.prod([len(axis.values) for axis in axes]))
    values = {axis.parameter: grid.ravel() for axis, grid in zip(axes, points, strict=True)}

    def value_of(name: str) -> np.ndarray:
        return values[name] if name in values else np.full(n, spec.values[name])

    frequency = values.get(FREQUENCY, np.full(n, np.nan if spec.frequency_hz is None else spec.frequency_hz))
    return axes, motion_of(ramp, value_of, frequency), frequency


def _coordinate(spec: Spec, ramp: Ramp) -> Coordinate:
    axes, motion, frequency = motion_over(spec, ramp)
    first, n_keep = spec.integration.n_transient + 1, spec.integration.n_keep
    periods = np.arange(first, first + n_keep)
    table = np.array([motion.at(i, periods / hz) for i, hz in enumerate(frequency)])
    shape = tuple(len(axis.values) for axis in axes)
    return Coordinate(
        at_section(ramp.parameter),
        (*(axis.dim for axis in axes), "period_index"),
        table.reshape(*shape, n_keep),
        _attrs(spec.model, ramp),
    )


def _attrs(model: Model, ramp: Ramp) -> dict[str, str]:
    parameter = model.parameter(ramp.parameter)
    return {"units": parameter.unit, "long_name": f"{parameter.meaning or parameter.name} at the section"}
