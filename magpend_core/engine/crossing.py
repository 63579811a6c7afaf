"""Give a system a Poincare section: its periods end where a state crosses a level."""

from __future__ import annotations

import dataclasses
from functools import cache

from magpend_core.engine.placeholders import no_forcing
from magpend_core.engine.system import System
from magpend_core.sizes import LEVEL


@cache
def with_section(system: System, of: str, direction: int) -> System:
    """Return `system` with a Poincare section: its periods end where a state crosses a level.

    The reciprocal of the drive frequency is then the longest wait for a crossing [s]; a cell that has none
    within it ends as `Status.NO_RETURN`. An angle crosses its level modulo 2 pi. The crossing that a
    trajectory starts on does not count.

    Parameters
    ----------
    system
        One without explicit time dependence.
    of
        Name of a state.
    direction
        +1 for crossings at which it rises, -1 where it falls.

    Returns
    -------
    System
        With one parameter more, the last: ``section_value``, the level.

    Raises
    ------
    ValueError
        If there is no such state, the direction is none, or the system depends on time.
    """
    if of not in system.state_names:
        raise ValueError(
            f"A section of {of!r}: {system.name} has no such state; it has {', '.join(system.state_names)}."
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
    index = system.state_names.index(of)
    return dataclasses.replace(
        system,
        name=f"{system.name}_section{index}_{'up' if direction > 0 else 'down'}",
        parameter_names=(*system.parameter_names, LEVEL),
        section=(index, direction),
    )
