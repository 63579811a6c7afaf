"""Define the table ``[section]`` of a specification: Poincare sections by level crossing, for models without a
drive.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from magpend_core.crossing import Crossing
from magpend_core.models.parameters import ParameterError
from magpend_core.models.sectioned import sectioned
from magpend_core.sizes import LEVEL
from pipeline.specification.tables import FREQUENCY, Table

if TYPE_CHECKING:
    from magpend_core.models.model import Model


class SectionTable(Table):
    """The table ``[section]``: the level crossing of a state or an expression that defines the Poincare section of a
    flow without a drive.
    """

    of: str = Field(
        min_length=1,
        description="What crosses the level: a state, a quantity, or an expression of the states such as `x + y - 1`.",
    )
    value: float = Field(default=0.0, description="Level, in the unit of `of`; for an angle, modulo 2 pi.")
    direction: Literal["up", "down"] = Field(default="up", description="Whether `of` rises or falls there.")
    longest: float = Field(
        default=100.0, gt=0, description="Longest time between crossings [s]; a cell that takes longer does not return."
    )

    @property
    def crossing(self) -> Crossing:
        """Poincare section as a `Crossing` object of the numerical core."""
        return Crossing(self.of, self.value, self.direction, self.longest)


def seen_through(model: Model, section: SectionTable | None) -> Model:
    """Return the model with the Poincare section of a table ``[section]``. Without such a table, return the model
    unchanged.
    """
    return model if section is None else sectioned(model, section.crossing)


def section_of(
    table: SectionTable | None, model: Model, data: Mapping[str, Any], problems: list[str]
) -> SectionTable | None:
    """Return the table ``[section]`` if it is valid for the model, else None; add its problems to `problems`.

    Parameters
    ----------
    table
        Valid table ``[section]``, or None.
    model
        Model of the specification.
    data
        Tables of the specification; axes, parameters and drive are checked.
    problems
        List to which problems are added.
    """
    if "section" not in data:
        if model.clock.has_equilibria:
            problems += _missing(model, data)
        return None
    if table is None:
        return None
    if model.clock.has_drive:
        problems.append(
            f"section: {model.name} has a drive, so its sections are once per drive period "
            f"({model.section}); drop [section], or remove time from the equations."
        )
        return None
    found = _found(table, model, problems)
    clash = "a section by crossing needs no frequency; drop one of the two"
    if FREQUENCY in data.get("parameters", {}):
        problems.append(f"parameters.{FREQUENCY}: {clash}.")
    if FREQUENCY in data.get("axes", {}):
        problems.append(f"axes.{FREQUENCY}: {clash}.")
    if "drive" in data:
        problems.append(f"drive: {model.name} has no drive that a recording could replace; drop the drive.")
    return found


def _found(table: SectionTable, model: Model, problems: list[str]) -> SectionTable | None:
    if LEVEL in model.parameter_names:
        problems.append(
            f"section: {model.name} has a parameter named {LEVEL}, which is the name of the level; rename it."
        )
        return None
    try:
        sectioned(model, table.crossing)
    except ParameterError as error:
        problems += error.problems
        return None
    return table


def _missing(model: Model, data: Mapping[str, Any]) -> list[str]:
    if FREQUENCY in data.get("parameters", {}) or FREQUENCY in data.get("axes", {}) or "drive" in data:
        return []
    return [
        f'section: missing; {model.name} has no drive. Add [section] with of = "{model.state_names[0]}", '
        f"value and direction, for sections by crossing; or parameters.{FREQUENCY}, for sections at even times."
    ]
