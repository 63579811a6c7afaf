"""Read how much of a run is computed, for ``magpend status``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.layout.plan import Plan
from pipeline.store.files import Files
from pipeline.store.run import RunDirectory


@dataclass(frozen=True)
class State:
    """State of a run: its committed tasks, and the number of committed cells by status.

    Attributes
    ----------
    files : Files
        Files of the run directory.
    title : str
        Title of the run.
    plan : Plan
        Plan of the run.
    done : frozenset of int
        Committed tasks.
    cells : dict
        Number of committed cells by status name.
    """

    files: Files
    title: str
    plan: Plan
    done: frozenset[int]
    cells: dict[str, int] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Path or URL of the run directory."""
        return self.files.name

    @property
    def n_committed(self) -> int:
        """Number of cells that are computed and committed."""
        return sum(self.cells.values())

    @property
    def complete(self) -> bool:
        """Whether every task of the run is committed."""
        return len(self.done) == self.plan.n_tasks

    def __str__(self) -> str:
        return "\n".join(describe_state(self))


def state(source: str | Path | Files | RunDirectory) -> State:
    """Read the state of a run: its committed tasks, and the number of cells by status.

    Raises
    ------
    RefusedError, DamagedError, UnreadableError
        See `RunDirectory.open`.
    """
    run = RunDirectory.open(source)
    return State(run.info.files, run.info.title, run.plan, frozenset(run.commits), run.commits.cells())


def describe_state(found: State) -> list[str]:
    """Return the lines that ``magpend status`` prints."""
    plan = found.plan
    share = 100 * found.n_committed / plan.n_cells
    lines = [found.title] if found.title else []
    lines += [
        f"{found.name}: {'complete' if found.complete else 'incomplete'}",
        f"committed: {found.n_committed} of {plan.n_cells} cells ({share:.1f} %), "
        f"{len(found.done)} of {plan.n_tasks} tasks",
    ]
    return lines + _status_lines(found.cells, plan.n_cells - found.n_committed)


def _status_lines(cells: Mapping[str, int], pending: int) -> list[str]:
    from magpend_core.status import Status

    numbers = {**cells, "pending": pending}
    return [
        f"  {s.name.lower():15s} {numbers[s.name.lower()]:>10d}  {s.sentence}"
        for s in Status
        if numbers.get(s.name.lower())
    ]
