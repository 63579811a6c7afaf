"""Declare the product ``rotation``: the rotation number of each cell. The integration continues from the cell's last
section point.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any

from pipeline.products.product import CellProduct, Options, Variable, flag_attrs, option


class RotationOptions(Options):
    """Options of the product ``rotation`` in a specification's table ``[products]``."""

    of: tuple[str, ...] = option(
        (),
        "What turns: an angle, or two states whose plane a trajectory turns in, clockwise; by default the model's "
        "only angle, or its two states.",
        max_length=2,
        strict=False,
    )
    center: tuple[float, float] = option((0.0, 0.0), "Point of the plane about which turns are counted.", strict=False)
    section: bool = option(
        False, "Count the turns of the section points about their mean, in [0, 1): for tori around an orbit."
    )
    n_periods: int = option(
        400, "Time over which the turns of orbits that are not closed are averaged.", unit="drive periods", ge=8
    )


class RotationFlag(IntEnum):
    """Flag for the reliability of a cell's rotation number."""

    ABSENT = 0
    GOOD = 1
    COARSE = 2
    FAILED = 3

    @property
    def sentence(self) -> str:
        """Meaning of the flag, as text."""
        return _FLAG_SENTENCES[self]


_FLAG_SENTENCES = {
    RotationFlag.ABSENT: "pending, or the cell has no attractor to go on from",
    RotationFlag.GOOD: "no objection",
    RotationFlag.COARSE: "turns may be miscounted: the trajectory comes too close to the centre",
    RotationFlag.FAILED: "the integration failed",
}

ROTATION_VARIABLES = (
    Variable("rotation", (), "float64", math.nan, "1", "rotation number: mean turns per drive period"),
    Variable(
        "rotation_error",
        (),
        "float64",
        math.nan,
        "1",
        "error of the rotation number",
        {
            "comment": "difference of the weighted averages over both halves of the time; of a closed orbit the "
            "distance of its turns from a whole number, per drive period"
        },
    ),
    Variable(
        "rotation_flag",
        (),
        "int8",
        int(RotationFlag.ABSENT),
        "1",
        "trust in the rotation number",
        flag_attrs(RotationFlag),
    ),
)
"""Variables of ``[products] rotation``."""


def _settled(options: RotationOptions, model: Any) -> RotationOptions:
    """Fill in the default angle or plane in which turns are counted; raise ValueError if the options do not fit the
    model.
    """
    from magpend_core.models.parameters import near_names

    if model.crossing is not None:
        raise ValueError(f"of: a rotation number counts turns per drive period, and {model.name} has no drive.")
    names, angles = model.state_names, [s.name for s in model.states if s.on_circle]
    of = options.of or (tuple(angles) if len(angles) == 1 and not options.section else ())
    of = of or (names if len(names) == 2 else ())
    if not of:
        raise ValueError(
            f"of: {model.name} has {len(names)} states; name an angle, or two states, such as {names[:2]}."
        )
    for name in of:
        if name not in names:
            raise ValueError(f"of: {name!r} is not a state of {model.name}; {near_names(name, names, 'states')}")
    if len(of) == 1 and of[0] not in angles:
        raise ValueError(f"of: {of[0]} is not an angle (on_circle = true); name two states, whose plane is turned in.")
    if len(of) == 1 and options.section:
        raise ValueError(
            f"section: section points turn in a plane; name two states with of, such as {list(names[:2])}."
        )
    if len(set(of)) < len(of):
        raise ValueError(f"of: {of[0]} is given twice; name two different states.")
    # a map has no path between its points, whose turns could be counted
    of_section = options.section or (len(of) > 1 and not model.clock.is_continuous)
    return options.model_copy(update={"of": of, "section": of_section})


def _variables(options: RotationOptions, model: Any) -> tuple[Variable, ...]:
    return ROTATION_VARIABLES


def _sizes(options: RotationOptions, model: Any) -> dict[str, int]:
    return {}


def _cost(options: RotationOptions) -> float:
    return float(options.n_periods)


def _shortest(options: RotationOptions) -> RotationOptions:
    return options.model_copy(update={"n_periods": 8})


ROTATION = CellProduct(
    "rotation",
    "Rotation number of each cell's attractor: mean turns per drive period, with an error.",
    RotationOptions,
    _variables,
    _sizes,
    _cost,
    "pipeline.compute.rotation:rotation",
    settle=_settled,
    shortest=_shortest,
)
