"""Copy cells (trajectories) from other runs that have cells with the same inputs, instead of integrating them again.

A worker opens the runs that cells are taken from once. For each task it looks up which of its cells they
hold, reads these from their committed chunks, compared with the records, and integrates the rest. What a run
holds but for a product is taken, and the product computed from its sections.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from magpend_core import Sections, Status
from pipeline.compute.integrate import WALKED, Integrate, Job, going_on, integrate, watched_quantities
from pipeline.layout.identity import numbered
from pipeline.layout.matching import NOWHERE, Finder, Way, unlike, way_of
from pipeline.layout.plan import Plan
from pipeline.layout.schema import base_variables
from pipeline.motion.steady import Inputs
from pipeline.products.product import function_of
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.spec import Spec
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.reading import read_block
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import read_run

Origin = tuple[str, str]
"""Directory and digest of a run that cells are taken from."""

Values = dict[str, np.ndarray]

ABSENT = (Status.PENDING, Status.INFERRED)
"""Statuses of committed cells that were not integrated."""


@dataclass
class Source:
    """An earlier run from which a new run copies cells."""

    run: RunDirectory  # the run, with the tasks that were committed when it was opened
    wanted: Spec  # specification of the run that takes its cells
    finder: Finder = field(init=False)
    names: list[str] = field(init=False)
    missing: list[str] = field(init=False)
    goes_on: bool = field(init=False)

    def __post_init__(self) -> None:
        self.finder = Finder(self.run.plan.cells)
        same = same_products(self.run, self.wanted)
        self.goes_on = self.run.spec.integration.n_keep < self.wanted.integration.n_keep
        # exponents begin at the last section, which is another then
        self.missing = [name for name in self.wanted.products if self.goes_on or name not in same]
        model = self.wanted.model
        products = [CELL_PRODUCTS[n].variables(self.wanted.products[n], model) for n in same]
        own = [*base_variables(model), *(v for variables in products for v in variables)]
        self.names = [variable.name for variable in own]
        self._is_committed = np.zeros(self.run.plan.n_tasks + 1, bool)
        self._is_committed[list(self.run.commits)] = True
        self._read = lru_cache(maxsize=2)(lambda task: read_block(self.run.info, self.run.commits[task], self.names))

    def find(self, inputs: Inputs, way: Way | None = None) -> np.ndarray:
        """Return for each wanted cell the flat index of the cell with the same inputs in this run; -1 if it has none.

        In a refined grid some of these were inferred, which `take` leaves out.
        """
        place = self.finder.find(inputs, way)
        return np.where(self._is_committed[self._task(place)], place, NOWHERE)

    def take(self, place: np.ndarray) -> tuple[np.ndarray, Values]:
        """Read stored cells; return which of them were integrated and are undamaged, and their variables."""
        taken = np.zeros(len(place), bool)
        values: Values = {}
        tasks = self._task(place)
        for task in np.unique(tasks[place != NOWHERE]):
            rows = np.flatnonzero(tasks == task)
            try:
                block = self._read(int(task))
            except DamagedError:
                continue
            inside = self._inside(int(task), place[rows])
            is_whole = ~np.isin(block["status"][inside], ABSENT)
            rows, inside = rows[is_whole], tuple(i[is_whole] for i in inside)
            taken[rows] = True
            for name, array in block.items():
                if name not in values:
                    values[name] = np.zeros((len(place), *array.shape[len(inside) :]), array.dtype)
                values[name][rows] = array[inside]
        return taken, {name: array[taken] for name, array in values.items()}

    def _task(self, place: np.ndarray) -> np.ndarray:
        """Return the task that contains each cell; a number beyond the last task for cells not in this run."""
        plan = self.run.plan
        steps = np.unravel_index(np.maximum(place, 0), plan.shape)
        places = tuple(step // b for step, b in zip(steps, plan.block, strict=True))
        tasks = np.ravel_multi_index(places, plan.task_grid) if places else np.zeros(place.shape, np.int64)
        return np.where(place == NOWHERE, plan.n_tasks, tasks)

    def _inside(self, task: int, place: np.ndarray) -> tuple[np.ndarray, ...]:
        steps = np.unravel_index(place, self.run.plan.shape)
        return tuple(step - s.start for step, s in zip(steps, self.run.plan.task(task), strict=True))


def same_products(run: RunDirectory, wanted: Spec) -> list[str]:
    """Return those products of a specification that a run has already computed with the same options and version."""
    versions = numbered(run.info.identity)["versions"]
    return [
        name
        for name, options in wanted.products.items()
        if run.spec.products.get(name) == options and versions.get(name) == CELL_PRODUCTS[name].version
    ]


def obstacles(run: RunDirectory, plan: Plan) -> list[str]:
    """Return the reasons why a new run, with its plan, cannot copy the cells of another one."""
    wanted, lines = plan.spec, unlike(run.info.identity, plan.identity)
    if line := _no_extension(run.spec, wanted):
        lines.append(line)
    same = same_products(run, wanted)
    return lines + [
        f"products.{name}: is watched while cells are integrated, and not as asked for in the directory"
        for name, options in wanted.products.items()
        if name not in same and CELL_PRODUCTS[name].watches(options)
    ]


def _no_extension(old: Spec, new: Spec) -> str:
    """Return the reason why stored cells cannot be integrated further for a new run; empty if they can."""
    had, wanted = old.integration.n_keep, new.integration.n_keep
    if had == wanted:
        return ""
    line = f"integration.n_keep: {had} in the directory, {wanted} now; "
    if wanted < had:
        return f"{line}fewer sections are not taken out of more"
    if new.continuation is not None:
        return f"{line}each point of a walk begins where all kept sections of the one before end"
    if new.section is not None:
        return f"{line}cells with a section by crossing do not go on"
    problem = new.motion.no_extension()
    return problem and line + problem


class Pool:
    """Earlier runs from which a new run copies cells; the first one that has a cell provides it."""

    def __init__(self, plan: Plan, runs: Sequence[RunDirectory]) -> None:
        self.plan = plan
        self.sources = [Source(run, plan.spec) for run in runs]

    def count(self, block: tuple[slice, ...]) -> list[int]:
        """Count the cells of a block that can be copied from each earlier run."""
        inputs, way = self.plan.cells.inputs(block), way_of(self.plan.cells, block)
        counts, rest = [], np.arange(len(inputs.initial_states))
        for source in self.sources:
            place = source.find(inputs.take(rest), way)
            found = place != NOWHERE
            if source.run.spec.refine is not None:  # what was inferred is not taken
                found[found] = source.take(place[found])[0]
            n_taken = _leading(found)
            counts.append(int(n_taken.sum()))
            rest = rest[n_taken == 0]
        return counts

    def integrator(self, block: tuple[slice, ...], tally: list[int]) -> Integrate:
        """Return a function that computes the cells of a block, and copies those that earlier runs have, with the same
        bits.

        The numbers of cells that were taken are appended to `tally`.
        """
        way = way_of(self.plan.cells, block)
        if way is None:
            return lambda spec, inputs: self._give(spec, inputs, inputs, None, tally)
        return lambda spec, inputs: self._give(spec, inputs, self.plan.cells.inputs(block), way, tally)

    def _give(self, spec: Spec, inputs: Inputs, begin: Inputs, way: Way | None, tally: list[int]) -> Values:
        """Return the variables of branches. The first points of each branch are copied, and the rest is integrated."""
        values: Values = {}
        n_branches, n_points = inputs.frequency_hz.shape
        rest = np.arange(n_branches)
        for source in self.sources:
            place = source.find(begin.take(rest), way)
            taken, stored = source.take(place.ravel())
            if source.goes_on and taken.any():
                taken, stored = self._go_on(spec, inputs.take(rest), source, taken, stored)
            n_taken = _leading(taken.reshape(place.shape))
            order = np.cumsum(taken).reshape(place.shape) - 1
            for n in np.unique(n_taken[n_taken > 0]):
                own = np.flatnonzero(n_taken == n)
                part = {name: array[order[own, :n]] for name, array in stored.items()}
                rows = rest[own]
                part |= _products(spec, _points(inputs.take(rows), slice(0, n)), part, source.missing)
                if n < n_points:
                    tail = _points(inputs.take(rows), slice(n, n_points))
                    more = integrate(spec, going_on(tail, {k: part[k][:, -1] for k in WALKED if k in part}))
                    part = {name: np.concatenate([part[name], more[name]], axis=1) for name in more}
                _put(values, rows, part, n_branches)
                tally.append(int(n) * len(rows))
            rest = rest[n_taken == 0]
        if len(rest):
            _put(values, rest, integrate(spec, inputs.take(rest)), n_branches)
        return values

    def _go_on(
        self, spec: Spec, inputs: Inputs, source: Source, taken: np.ndarray, stored: Values
    ) -> tuple[np.ndarray, Values]:
        """Integrate copied cells further for more section points. Return which cells succeeded, and their variables."""
        rows = np.flatnonzero(taken)
        points = {name: array[:, None] for name, array in stored.items()}
        n_old, watched = source.run.spec.integration.n_keep, watched_quantities(spec)
        is_exact, longer = spec.motion.extend(inputs.take(rows), points, n_old, watched)
        taken = taken.copy()
        taken[rows[~is_exact]] = False
        return taken, {name: array[:, 0] for name, array in longer.items()}


def _leading(taken: np.ndarray) -> np.ndarray:
    """Count the copied cells of each branch from its start up to the first missing cell."""
    return np.asarray(np.cumprod(taken, axis=1).sum(axis=1))


def _points(inputs: Inputs, part: slice) -> Inputs:
    return replace(inputs, parameters=inputs.parameters[:, part], frequency_hz=inputs.frequency_hz[:, part])


def _put(values: Values, rows: np.ndarray, part: Mapping[str, np.ndarray], n: int) -> None:
    for name, array in part.items():
        if name not in values:
            values[name] = np.zeros((n, *array.shape[1:]), array.dtype)
        values[name][rows] = array


def _products(spec: Spec, inputs: Inputs, values: Mapping[str, np.ndarray], names: Sequence[str]) -> Values:
    """Compute products of cells whose section points and status are known."""
    if not names:
        return {}
    no_turns = np.zeros((*inputs.frequency_hz.shape, 0), np.int32)
    cells = Sections(
        section=values["section"],
        turns=values.get("turns", no_turns),
        status=values["status"],
        orbit_period=values["orbit_period"],
        n_periods=values["n_periods"],
        n_steps=values["n_steps"],
        n_rejected=values["n_rejected"],
        final_state=values["section"][:, :, -1],
        step_size=values["step_size"],
        return_time=values.get("return_time"),
        extremes=values.get("extremes"),
    )
    found: Values = {}
    for name in names:
        found |= function_of(CELL_PRODUCTS[name].compute)(Job(spec, inputs, cells), spec.products[name])
    return found


@lru_cache(maxsize=2)
def pool_of(directory: str, digest: str, sources: tuple[Origin, ...]) -> Pool:
    """Open the earlier runs from which the run in a directory copies cells, once per worker.

    Raise `RefusedError` if a directory holds another run now.
    """
    runs = []
    for place, expected in sources:
        run = RunDirectory.open(place)
        if run.info.digest != expected:
            raise RefusedError(f"{place}: another run stands there than when its cells were looked up.")
        runs.append(run)
    return Pool(read_run(directory).plan, runs)
