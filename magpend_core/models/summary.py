"""Describe a model: its equations, the features that limit the integrator's steps, and the results of the checks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from magpend_core.models.model import Model, Parameters


def checks_of(model: Model) -> list[str]:
    """Return the names of the checks that `describe` makes for a model."""
    return [
        "finite at the starts",
        "Jacobian equal to differences",
        *(["nothing changes as an angle goes round"] if model.angles else []),
        *(["forcing of the drive's period"] if model.clock.has_drive else []),
    ]


@dataclass(frozen=True)
class Description:
    """Description of a model: equations, features that limit the integrator's steps, and problems found by the checks.

    Attributes
    ----------
    definitions, equations : dict
        As they were understood, by name; empty of a model that is no text.
    latex : list of str
        Lines of them, aligned at ``&=``.
    found : list of str
        A sentence for each kind of place that steps are chosen by: edges, layers, switches, impacts.
    problems : list of str
        What the checks found wrong.
    """

    definitions: dict[str, str] = field(default_factory=dict)
    equations: dict[str, str] = field(default_factory=dict)
    latex: list[str] = field(default_factory=list)
    found: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def describe(parameters: Parameters, frequency_hz: float, states: np.ndarray) -> Description:
    """Check and describe a model at the parameters of a run; imports the compiler, but compiles nothing.

    Parameters
    ----------
    parameters
        Of the model.
    frequency_hz
        Of the drive [Hz].
    states
        Starts, shape (n, n_states).
    """
    from magpend_core.engine.checks import SystemCheckError, check_system

    model, system = parameters.model, parameters.model.system
    packed, frequency = parameters.pack()[None], np.array([frequency_hz], np.float64)
    problems: list[str] = []
    try:
        check_system(system, packed, frequency, states, jacobian=system.jacobian is not None)
    except SystemCheckError as error:
        problems = list(error.problems)
    found = [] if problems else list(_found(parameters, float(frequency_hz), states))
    return Description(*_written(model), found, problems)


def _written(model: Model) -> tuple[dict[str, str], dict[str, str], list[str]]:
    """Return the definitions, equations and LaTeX lines of a model given as text; empty for other models."""
    from magpend_core.models.text.model import TextModel

    if not isinstance(model, TextModel):
        return {}, {}, []
    from magpend_core.models.text.latex import equations_of

    own = model.definition
    used = {line.key.text for line in own.lines_of(own.dynamics)}
    written = {key: str(text) for key, text in own.table.get("define", {}).items() if key in used}
    equations = {own.lines[name].key.text: own.lines[name].text for name in own.equations}
    return written, equations, equations_of(own)


def _found(parameters: Parameters, frequency_hz: float, states: np.ndarray) -> Iterator[str]:
    """Yield a sentence for each forcing edge, boundary layer, switch and impact at which the integrator adapts its
    steps.
    """
    from magpend_core.engine.plain_python import plain
    from magpend_core.models.text.model import TextModel

    model, system, p = parameters.model, parameters.model.system, parameters.pack()
    if system.n_edges:
        table = np.full((3, system.n_edges), np.nan)
        plain(system.edges)(np.float64(frequency_hz), p, *table)
        times = ", ".join(f"{t * frequency_hz:.6g}" for t in table[0])
        yield f"edges: {system.n_edges} per period of the drive, at {times} of it"
    if isinstance(model, TextModel):
        from magpend_core.models.text.detected import found_in

        yield from found_in(model, parameters, frequency_hz, states[0])
    elif system.has_layers:
        yield "layers: where equations are steep, as the model says itself"
