"""Count the cells of a run by status: what is computed by now, and what became of the cells of a finished run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from magpend_core.status import Status
from pipeline.layout.own_words import dims_in_own_words, in_own_words
from pipeline.layout.small_states import small_states
from pipeline.layout.vocabulary import DIVERGED, FAILED, PENDING, parameter_name, split_dims
from pipeline.specification.tables import EXPLICIT
from pipeline.store.files import Files
from pipeline.store.run import RunDirectory

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True, repr=False)
class State(RunDirectory):
    """An opened run whose text says how many cells are committed, by status."""

    @property
    def cells(self) -> dict[str, int]:
        """Number of committed cells by status name."""
        return self.commits.cells()

    def __str__(self) -> str:
        return "\n".join(describe_state(self))


def state(source: str | Path | Files | RunDirectory) -> State:
    """Read the state of a run: its committed tasks, and the number of cells by status.

    Raises
    ------
    RefusedError, DamagedError, UnreadableError
        See `RunDirectory.open`.
    """
    return State.open(source)


def describe_state(found: State) -> list[str]:
    """Return the lines that ``magpend status`` prints."""
    plan = found.plan
    share = 100 * found.n_committed / plan.n_cells
    lines = [found.spec.title] if found.spec.title else []
    lines += [
        f"{found.name}: {'complete' if found.complete else 'incomplete'}",
        f"committed: {found.n_committed} of {plan.n_cells} cells ({share:.1f} %), "
        f"{len(found.commits)} of {plan.n_tasks} tasks",
    ]
    method = found.spec.integration.method
    lines += [f"method: {method}"] * (method != EXPLICIT)
    lines += _status_lines(found.cells, plan.n_cells - found.n_committed, method)
    return lines + (small_states(found.parameters, found.cube) if found.complete else [])


def _status_lines(cells: Mapping[str, int], pending: int, method: str) -> list[str]:
    numbers = {**cells, "pending": pending}
    return [
        f"  {s.name.lower():15s} {numbers[s.name.lower()]:>10d}  {s.advice_for(method)}"
        for s in Status
        if numbers.get(s.name.lower())
    ]


WORTH_A_WARNING = 0.01
"""Fraction of diverged and failed cells above which a run ends with a warning."""

Range = tuple[str, float, float, str]
"""Axis, its smallest and largest value, its unit."""


@dataclass(frozen=True)
class Outcome:
    """Cells of a run that have one status, such as diverged: their number, share and parameter ranges."""

    status: Status  # status of the cells
    n_cells: int  # number of cells
    share: float  # fraction of all cells of the run
    # ranges of swept parameters in which these cells lie, without parameters whose whole range they cover
    where: tuple[Range, ...]

    @property
    def word(self) -> str:
        """Status in words."""
        return self.status.name.lower().replace("_", " ")

    @property
    def place(self) -> str:
        """Parameter ranges of the cells, such as ``frequency = 2.4 to 2.5 Hz``; an empty text if they are
        everywhere.
        """
        return ", ".join(
            f"{name} = {low:.6g}" + (f" to {high:.6g}" if high > low else "") + (f" {unit}" if unit else "")
            for name, low, high, unit in self.where
        )

    @property
    def line(self) -> str:
        """Text line with the status, the number of cells, their percentage and their parameter ranges."""
        text = f"  {self.word:15s} {self.n_cells:>10d} {100 * self.share:>6.1f} %"
        return text + (f"  {self.place}" if self.where else "")


def outcomes_of(run: RunDirectory) -> list[Outcome]:
    """Count the cells of a run that have each status, and find their parameter ranges."""
    status = in_own_words(run.cube())["status"].load()
    codes = np.flatnonzero(np.bincount(status.values.ravel().astype(np.int64)))
    return [_outcome(status, Status(int(code))) for code in codes]


def _outcome(status: xr.DataArray, code: Status) -> Outcome:
    there = status == code
    n_cells = int(there.sum())
    ranges = []
    for dim in split_dims(status)[0]:
        values = status[dim].values.astype(np.float64)
        own = values[there.any([d for d in status.dims if d != dim]).values]
        if 0 < own.size < values.size:
            unit = str(status[dim].attrs.get("units", ""))
            ranges.append((dim, float(own.min()), float(own.max()), "" if unit == "1" else unit))
    return Outcome(code, n_cells, n_cells / max(status.size, 1), tuple(ranges))


def summary(run: RunDirectory) -> list[str]:
    """Return the text lines that ``magpend run`` prints at its end: cells by status, and suggested commands."""
    from pipeline.runs.preview import figure_command

    found = outcomes_of(run)
    lines = [f"{run.plan.n_cells} cells by status:", *(o.line for o in found), *small_states(run.parameters, run.cube)]
    lines.append(f"plot it with: {figure_command(run)}")
    lost = lost_cells(found)
    if lost:
        lines.append(f"what each status means: magpend status {run.name}")
        zoom = _zoom(lost, run)
        lines += [f"look closer at the lost cells: {zoom}"] if zoom else []
    return lines


def lost_cells(found: Iterable[Outcome]) -> list[Outcome]:
    """Select the outcomes of cells that diverged or failed."""
    return [o for o in found if o.status in (DIVERGED, *FAILED)]


def warning(run: RunDirectory) -> str:
    """Return a warning if too many of a run's cells diverged or failed; an empty text otherwise."""
    found = outcomes_of(run)
    lost, computed = lost_cells(found), sum(o.n_cells for o in found if o.status != PENDING)
    n_lost = sum(o.n_cells for o in lost)
    if n_lost <= WORTH_A_WARNING * computed:
        return ""
    method = run.spec.integration.method
    told = "; ".join(
        f"{o.n_cells} {o.word}" + (f" at {o.place}" if o.where else "") + f": {o.status.advice_for(method)}"
        for o in lost
    )
    return (
        f"warning: {n_lost} of {computed} cells ({100 * n_lost / computed:.1f} %) diverged or failed; "
        f"figures omit them. {told}."
    )


def _zoom(lost: list[Outcome], run: RunDirectory) -> str:
    """Return a ``magpend zoom`` command for the ranges in which cells diverged or failed; an empty text if there are
    none.
    """
    whole = dict(zip(dims_in_own_words(run.plan.dims, run.spec.rate), run.plan.shape, strict=True))
    spans: dict[str, tuple[float, float]] = {}
    for dim in (d for d, n in whole.items() if n > 1):
        ranges = [r for o in lost for r in o.where if r[0] == dim]
        if len(ranges) == len(lost):  # none of them is everywhere
            spans[dim] = min(r[1] for r in ranges), max(r[2] for r in ranges)
    words = " ".join(
        f"--axis {parameter_name(dim)}={low:.10g}:{high:.10g}"
        if high > low
        else f"--at {parameter_name(dim)}={low:.10g}"
        for dim, (low, high) in spans.items()
    )
    return f"magpend zoom {run.name} {words} --out closer.toml" if words else ""
