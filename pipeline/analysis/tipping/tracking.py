"""Tell tracking, returning and tipping apart: whether trajectories keep to the attractor on which they begin.

The attractor is continued along the motion of the parameters in small steps: its state at one value is the start at
the next value. Where the same steps back end elsewhere, the attractor does not continue. Trajectories whose parameters
go there and back are integrated without the way back, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from magpend_core import Status
from magpend_core.models.drift.ramps import RampOfCells, motions_of
from magpend_core.models.model import Model, Parameters
from pipeline.analysis.attractors.destinations import ELSEWHERE
from pipeline.analysis.tipping.declaration import COURSES, TippingOptions
from pipeline.analysis.tipping.endings import (
    GOOD,
    UNKNOWN_END,
    Final,
    Group,
    Known,
    compared,
    drifted,
    endings,
    held_at,
    known_of,
)
from pipeline.motion.drifting import Drifting
from pipeline.motion.steady import Inputs, Steady
from pipeline.results.outcomes import DIVERGED
from pipeline.results.run import OpenRun
from pipeline.results.sets import Geometry
from pipeline.results.tolerances import CELL_CLOSURE

Cells = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Packed parameters (cell, parameter), frequencies (cell,) and initial states (cell, state) of a run's cells."""

UNDECIDED_COURSE, TRACKING, RETURNING, TIPPING, RETURN_TIPPING = range(len(COURSES))


@dataclass(frozen=True)
class Ends:
    """Attractors on which cells end at constant parameters."""

    outcome: np.ndarray  # (cell,): number of the attractor, `DIVERGED`, or `UNKNOWN_END`
    known: Known  # the attractors by these numbers

    @classmethod
    def of(cls, groups: Sequence[Group]) -> Ends:
        """Number the attractors of groups."""
        number = count()
        ids = [{int(o): next(number) for o in np.unique(g.outcome[g.outcome >= 0])} for g in groups]
        outcome = np.zeros(sum(len(g.cells) for g in groups), np.int64)
        for group, own in zip(groups, ids, strict=True):
            outcome[group.cells] = [own.get(int(o), int(o)) for o in group.outcome]
        return cls(outcome, known_of(groups, ids))

    def state(self, number: int) -> np.ndarray:
        """Return a state on an attractor."""
        return next(states[labels == number][0] for _, states, labels in self.known.values() if number in labels)


@dataclass(frozen=True)
class Path:
    """The way of an attractor from its first to other parameters."""

    number: int  # of the attractor
    target: Final
    parameters: np.ndarray  # (step, parameter): from the first ones to those of the target


def courses(run: OpenRun, cells: Cells, reached: Ends, options: TippingOptions) -> np.ndarray:
    """Return for each cell the number of its course in `COURSES`, from the attractors that the cells have reached."""
    packed, frequency_hz, starts = cells
    spec, motion = run.spec, run.spec.motion
    assert isinstance(motion, Drifting)
    motions = motions_of(spec.ramps, spec.values.names, packed, frequency_hz)
    begins = held_at(spec, packed, frequency_hz, motions, "begin")
    run.echo("tipping: the attractors at the first parameters")
    origins = _origins(run, begins, starts, options)
    ends = held_at(spec, packed, frequency_hz, motions)
    stays = _stays(run, _paths(motions, begins, ends, origins, options), origins, reached, options)
    out = tuple(ramp.way_out for ramp in spec.ramps)
    if out == spec.ramps:
        return course_of(stays, stays)
    run.echo("tipping: the same without the way back")
    motions = motions_of(out, spec.values.names, packed, frequency_hz)
    turns = held_at(spec, packed, frequency_hz, motions)
    found = drifted(replace(motion, ramps=out), packed, frequency_hz, starts)
    there = Ends.of([*endings(run, turns, found.final_state[:, 0], found.status[:, 0], options)])
    away = _stays(run, _paths(motions, begins, turns, origins, options), origins, there, options)
    return course_of(stays, away)


def course_of(stays: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Return courses, from whether cells end on the attractor on which they begin, 1, not, 0, or not decided, -1.

    `away` tells the same of the motion without the way back.
    """
    course = np.full(len(stays), UNDECIDED_COURSE)
    course[(stays == 1) & (away == 1)] = TRACKING
    course[(stays == 1) & (away == 0)] = RETURNING
    course[stays == 0] = TIPPING
    course[(stays == 0) & (away == 1)] = RETURN_TIPPING
    return course


def _origins(run: OpenRun, begins: Sequence[Final], starts: np.ndarray, options: TippingOptions) -> Ends:
    """Return the attractors to which the starts lead at the first parameters; equal cells are integrated once."""
    keys = [final.key + start.tobytes() for final, start in zip(begins, starts, strict=True)]
    first = {key: i for i, key in reversed([*enumerate(keys)])}
    cells = sorted(first.values())
    status = np.full(len(cells), int(Status.BOUNDED))
    found = Ends.of([*endings(run, [begins[i] for i in cells], starts[cells], status, options)])
    place = {keys[i]: n for n, i in enumerate(cells)}
    return Ends(found.outcome[[place[key] for key in keys]], found.known)


def _paths(
    motions: Sequence[RampOfCells],
    begins: Sequence[Final],
    targets: Sequence[Final],
    origins: Ends,
    options: TippingOptions,
) -> list[Path | None]:
    """Return the way of each cell's attractor; None of a cell without one. Equal ways are one object."""
    found: dict[bytes, Path] = {}
    paths: list[Path | None] = []
    for cell, (begin, target) in enumerate(zip(begins, targets, strict=True)):
        number = int(origins.outcome[cell])
        if number < 0:
            paths.append(None)
            continue
        rows = np.tile(begin.parameters.pack(), (options.steps + 1, 1))
        if begin.key != target.key:
            names = begin.parameters.names
            rows[:, [names.index(m.ramp.parameter) for m in motions]] = waypoints(motions, cell, options.steps)
            rows[-1] = target.parameters.pack()
        key = b"".join([np.int64(number).tobytes(), target.key, rows.tobytes()])
        paths.append(found.setdefault(key, Path(number, target, rows)))
    return paths


def waypoints(motions: Sequence[RampOfCells], cell: int, steps: int) -> np.ndarray:
    """Return values of the moving parameters along a cell's motion, in steps of equal size; shape (steps + 1, moving).

    The size of a step is the largest change of a parameter, as a part of its range. Rates have no influence.
    """
    pieces, digits = 256, 9  # of each motion; of the parts of a range, so that equal ways have equal bits
    times = np.unique(np.concatenate([motion.corners(cell, pieces) for motion in motions]))
    values = np.column_stack([motion.at(cell, times) for motion in motions])
    span = np.where(np.ptp(values, axis=0) > 0, np.ptp(values, axis=0), 1.0)
    shares = (values - values[0]) / span
    come = np.append(0.0, np.cumsum(np.abs(np.diff(shares, axis=0)).max(axis=1)))
    at = np.linspace(0.0, come[-1], steps + 1)
    return np.asarray(values[0] + span * np.column_stack([np.interp(at, come, s) for s in shares.T]).round(digits))


def _stays(
    run: OpenRun, paths: Sequence[Path | None], origins: Ends, ends: Ends, options: TippingOptions
) -> np.ndarray:
    """Return 1 for cells that end on the attractor that continues the one on which they begin, 0 for others, -1 for
    those that are not decided.
    """
    distinct = [*{id(path): path for path in paths if path is not None}.values()]
    label = np.zeros(0, np.int64)
    if distinct:
        starts = np.array([origins.state(path.number) for path in distinct])
        states, label = _continued(run, distinct, starts, options)
        own = np.flatnonzero(label == 0)
        status = np.full(len(own), int(Status.BOUNDED))
        targets = [distinct[i].target for i in own]
        label[own] = compared(run, ends.known, targets, states[own], status, options)
        label[label == DIVERGED] = ELSEWHERE
    number = {id(path): int(n) for path, n in zip(distinct, label, strict=True)}
    wanted = np.array([UNKNOWN_END if path is None else number[id(path)] for path in paths])
    decided = (wanted != UNKNOWN_END) & (ends.outcome != UNKNOWN_END)
    return np.where(decided, wanted == ends.outcome, -1).astype(np.int64)


def _continued(
    run: OpenRun, paths: Sequence[Path], starts: np.ndarray, options: TippingOptions
) -> tuple[np.ndarray, np.ndarray]:
    """Continue attractors along their ways; return states at the targets, and whether they continue there.

    The second has 0 for attractors that do, `ELSEWHERE` for those that do not, and `UNKNOWN_END`.
    """
    model, steps = paths[0].target.parameters.model, options.steps
    there_and_back = np.array([np.concatenate([path.parameters, path.parameters[-2::-1]]) for path in paths])
    frequency = np.repeat([[path.target.frequency_hz] for path in paths], 2 * steps + 1, axis=1)
    length = {"n_transient": options.settle, "n_keep": options.keep, "stop_when_closed": False}
    motion = Steady(model, run.spec.integration.model_copy(update=length))
    run.echo(f"tipping: continuing {len(paths)} attractors in {steps} steps")
    found, _ = motion.integrate(Inputs(there_and_back, frequency, starts), None)
    good = np.asarray(np.isin(found.status, GOOD).all(axis=1))
    code = np.where(good, 0, np.where((found.status == Status.DIVERGED).any(axis=1), ELSEWHERE, UNKNOWN_END))
    last, back = found.section[:, :steps, -1], found.section[:, :steps:-1]
    closed = (found.status[:, :steps] == Status.PERIODIC) & (found.status[:, :steps:-1] == Status.PERIODIC)
    with np.errstate(invalid="ignore"):  # ways that failed have no states
        gap = Geometry.of(model).distance(back, last[:, :, None]).min(axis=-1)
    gap[closed & (gap <= CELL_CLOSURE)] = 0.0
    return found.section[:, steps, -1], _compared_steps(
        run, there_and_back, frequency, (last, back[:, :, -1]), gap, code, options
    )


def _compared_steps(
    run: OpenRun,
    parameters: np.ndarray,
    frequency: np.ndarray,
    states: tuple[np.ndarray, np.ndarray],
    gap: np.ndarray,
    code: np.ndarray,
    options: TippingOptions,
) -> np.ndarray:
    """Compare the attractors of each way there and back; return the code of each way, see `_continued`.

    Only ways with the code 0 are compared; the others keep theirs.

    States (2, way, step, state) are those on the way there and back. Of each way the steps with the largest gaps
    between these are compared.
    """
    most = 3  # steps of a way that are compared
    model: Model = run.spec.model.still  # type: ignore[attr-defined]
    code, unsure = code.copy(), np.zeros(len(code), bool)
    order = np.argsort(-gap, axis=1)
    for rank in range(min(most, order.shape[1])):
        step = order[:, rank]
        ways = np.flatnonzero((code == 0) & (gap[np.arange(len(gap)), step] > 0.0))
        if not len(ways):
            break
        step = step[ways]
        finals = [
            Final(_parameters(model, row), hz)
            for row, hz in zip(parameters[ways, step], frequency[ways, 0], strict=True)
        ]
        ends = np.concatenate([one[ways, step] for one in states])
        status = np.full(len(ends), int(Status.BOUNDED))
        there, again = np.split(Ends.of([*endings(run, finals * 2, ends, status, options)]).outcome, 2)
        unknown = (there == UNKNOWN_END) | (again == UNKNOWN_END)
        unsure[ways] |= unknown
        code[ways[~unknown & (there != again)]] = ELSEWHERE
    code[unsure & (code == 0)] = UNKNOWN_END
    return code


def _parameters(model: Model, packed: np.ndarray) -> Parameters:
    return Parameters(model, dict(zip(model.parameter_names, packed.tolist(), strict=True)))
