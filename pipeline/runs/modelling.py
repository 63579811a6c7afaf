"""Describe and check a model without a run, as ``magpend model`` does."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magpend_core.models.model import Model, Parameters
from pipeline.layout.cells import CellMap
from pipeline.layout.evaluation import check_starts, check_states
from pipeline.specification.files import check_new_file, read_toml, write_new
from pipeline.specification.models import find_model, is_model_file
from pipeline.specification.parsing import KINDS
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.specification.tables import FREQUENCY
from pipeline.store.local import refuse_place

if TYPE_CHECKING:
    from magpend_core.models.summary import Description

TEMPLATE = Path(__file__).parents[1] / "specification" / "template.toml"
NEAR_ZERO = (0.0, 0.1, -0.2, 0.3)
"""Initial states in units of the states' scales, if no specification gives any."""


def examine(name: str) -> tuple[Model, Description]:
    """Describe and check a model, at initial states near 0 or at those of a specification that uses it.

    Parameters
    ----------
    name
        Name of a model that ships; path of a model's file or of a specification; or ``package.module:NAME``,
        which is imported.

    Raises
    ------
    SpecError
        If there is no such model, or it is not valid, or its equations have no value at the starts.
    """
    from magpend_core.models.summary import describe

    spec = _specification(name)
    if spec is None:
        model = find_model(name)
        parameters, frequency_hz, states = _near_zero(model)
    else:
        check_starts(spec)
        parameters, frequency_hz, states = _first_cells(spec)
        model = parameters.model
    return model, describe(parameters, frequency_hz, states)


def _specification(name: str) -> Spec | None:
    if not is_model_file(name) or read_toml(name).get("kind") not in KINDS:
        return None
    return Spec.read(name)


def _near_zero(model: Model) -> tuple[Parameters, float, np.ndarray]:
    parameters = model.load()
    states = np.outer(NEAR_ZERO, np.asarray(model.scales))
    good = []
    for row in states:  # the state 0 is often an equilibrium, and sometimes a pole of the equations
        try:
            check_states(model, row[None], [{**parameters, FREQUENCY: 1.0}])
            good.append(row)
        except SpecError:
            pass
    if not good:
        check_states(model, states, [{**parameters, FREQUENCY: 1.0}])
    return parameters, 1.0, np.array(good)


def _first_cells(spec: Spec) -> tuple[Parameters, float, np.ndarray]:
    cells = CellMap(spec)
    block = tuple(slice(0, 1) if i != cells.path else slice(0, n) for i, n in enumerate(cells.shape))
    inputs = cells.inputs(block)
    names = spec.values.names
    values = dict(zip(names, inputs.parameters[0, 0].tolist(), strict=True))
    model = spec.model.flow
    parameters = Parameters(model, {name: values[name] for name in model.parameter_names})
    return parameters, float(inputs.frequency_hz[0, 0]), inputs.initial_states


def write_template(path: Path | None) -> str:
    """Return the template of a specification with its own model; write it to a file if a path is given.

    Raises
    ------
    SpecError
        If the file exists or its folder does not.
    """
    text = TEMPLATE.read_text("utf-8")
    if path is None:
        return text
    check_new_file(path, [".toml"])
    refuse_place(path)
    write_new(path, text, "FILE")
    return text
