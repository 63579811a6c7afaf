"""Give a system a Poincare section: its periods end where a state, or a function of the states, crosses a level."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

from magpend_core.engine.jit import inline
from magpend_core.engine.placeholders import no_forcing
from magpend_core.engine.system import System
from magpend_core.sizes import LEVEL


@cache
def with_section(system: System, of: str, direction: int) -> System:
    """Return `system` with a Poincare section: its periods end where a state, or its `surface`, crosses a level.

    One over the drive frequency is then the longest time to wait for a crossing [s]; a trajectory without a crossing
    in this time ends as `Status.NO_RETURN`. An angle crosses its level modulo 2 pi. If a trajectory starts on the
    section, this does not count as a crossing.

    Parameters
    ----------
    system
        System without explicit time dependence.
    of
        Name of a state. If the system has a `surface`, what that is, for messages.
    direction
        +1 for crossings with rising state, -1 with falling state.

    Returns
    -------
    System
        System with one more parameter at the end: the level, ``section_value``.

    Raises
    ------
    ValueError
        If there is no such state, the direction is none, or the system depends on time.
    """
    if system.surface is None and of not in system.state_names:
        hint = "" if of.isidentifier() else " For an expression give a model as text its section: `sectioned`."
        raise ValueError(
            f"A section of {of!r}: {system.name} has no such state; it has {', '.join(system.state_names)}.{hint}"
        )
    if direction not in (1, -1):
        raise ValueError(f"direction = {direction!r} of a section must be 1 (rising) or -1 (falling).")
    if system.forcing is not no_forcing or system.n_edges:
        raise ValueError(
            f"{system.name} depends on time: its sections are at the period of its drive; "
            "sections by crossing are for autonomous systems."
        )
    if system.section is not None:
        raise ValueError(f"{system.name} has a section already.")
    index = system.state_names.index(of) if system.surface is None else None
    return dataclasses.replace(
        system,
        name=system.name + _suffix(index, direction),
        parameter_names=(*system.parameter_names, LEVEL),
        section=(index, direction),
    )


def without_section(system: System) -> System:
    """Return a system as it was before `with_section`; its parameters end before the level."""
    if system.section is None:
        return system
    name = system.name.removesuffix(_suffix(*system.section))
    return dataclasses.replace(
        system, name=name, parameter_names=system.parameter_names[:-1], section=None, surface=None
    )


def _suffix(index: int | None, direction: int) -> str:
    """Return the part of the name of a system that stands for its section."""
    return f"_section{'' if index is None else index}_{'up' if direction > 0 else 'down'}"


def slopes_of(system: System) -> Any:
    """Return a function (t, y, c) that gives a system's `surface` and its derivatives by the states as one tuple."""
    n = range(system.n_states)
    along = [", ".join("one" if j == i else "zero" for j in n) for i in n]
    lines = ["def section_slopes(t, y, c):", "zero = 0.0 * y[0]", "one = zero + 1.0"]
    slopes = [f"_surface(t, y, ({one},), c)[0][1]" for one in along]
    lines.append(f"return (_surface(t, y, ({along[0]},), c)[0][0], {', '.join(slopes)})")
    scope: dict[str, Any] = {"__name__": system.rhs.__module__, "_surface": system.surface}
    exec("\n    ".join(lines), scope)
    return inline(scope["section_slopes"])
