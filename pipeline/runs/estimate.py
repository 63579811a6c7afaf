"""Estimate how long a run takes on this machine, by integrating a sample of its cells over a few periods.

The rule of thumb in `pipeline.layout.plan` gives the dependence of the time on frequency and tolerance. Two
further quantities are measured: the speed of this processor for this system, and, if the run stops when
orbits have closed, the number of periods until they do.
"""

from __future__ import annotations

import itertools
import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.layout.plan import Plan, mean_seconds_per_period, periods_per_cell
from pipeline.motion.steady import Inputs
from pipeline.products.registry import CELL_PRODUCTS
from pipeline.specification.spec import Spec

BRANCHES, MOST_SAMPLED_BRANCHES, POINTS = 32, 256, 8
"""Size of a sample: branches (two groups of lanes or more), most branches, points of each branch."""


LEAST_PERIODS = 8

WRITTEN, WRITING_S = 20, 0.5
"""Number of tasks that are written to time the writing, and the most time for it [s]."""

FILE_S = 0.004
"""Time to write a file, by the rule [s]."""

MOST_WRITTEN_BYTES, MOST_WRITTEN_CELLS = 20_000_000, 1_000_000
"""Size of a task [bytes] and of a run [cells] above which a rule gives the time of writing."""


@dataclass(frozen=True)
class Estimate:
    """Estimated computing time of a run on one core of this machine."""

    core_seconds: float  # time of all cells on one core [s]
    how: str  # phrase on how it was measured
    compiled_s: float  # time spent on compiling [s]


def estimate(plan: Plan) -> Estimate:
    """Estimate the computing time of a run on one core of this machine, from a sample of its cells.

    This takes less than a second, after compiling. The time of products (exponents) is their number of periods
    times the measured time of one.
    """
    from pipeline.compute.task import warm_up

    spec, compiled_s = plan.spec, warm_up(plan)
    most, products = periods_per_cell(spec)
    # products that the engine computes while integrating are measured with it
    watched = {name: o for name, o in spec.products.items() if CELL_PRODUCTS[name].watches(o)}
    spec = spec.replace(products=watched)
    plan = replace(plan, spec=spec)
    products -= periods_per_cell(spec)[1]
    inputs = _sample(plan, np.random.default_rng(0), BRANCHES, pairs=False)
    ratio, measured, seconds = _speed(spec, inputs, most)
    how = f"measured: {inputs.frequency_hz.size} of its cells over {measured} periods, {seconds:.1f} s"
    periods = most
    if spec.integration.stop_when_closed:
        periods = _periods_until_closed(plan, most, ratio)
        how += f"; a cell takes {periods:.0f} of at most {most:.0f} periods until it has closed"
    per_cell = ratio * mean_seconds_per_period(spec) * (periods + products)
    return Estimate(per_cell * plan.n_cells, how, compiled_s)


def writing_seconds(plan: Plan) -> float:
    """Measure how long it takes to write the files of one task to a temporary folder [s].

    Returns
    -------
    float
        Time of a task's files and its commit record [s].
    """
    from pipeline.store.keys import keys_of
    from pipeline.store.setup import create
    from pipeline.store.tasks import write_task

    n_files = len(keys_of(plan, 0)) + 1
    if plan.n_cells > MOST_WRITTEN_CELLS or plan.n_bytes / plan.n_tasks > MOST_WRITTEN_BYTES:
        return n_files * FILE_S
    rng, taken = np.random.default_rng(0), []
    with tempfile.TemporaryDirectory(prefix="magpend-estimate-") as folder:
        info = create(Path(folder) / "run", plan)
        plan = info.plan
        for index in range(min(WRITTEN, plan.n_tasks)):
            shape = tuple(s.stop - s.start for s in plan.task(index))
            values = {
                v.name: rng.uniform(1, 5, (*shape, *(plan.sizes[d] for d in v.own_dims))).astype(v.dtype)
                for v in plan.variables
            }
            started = time.perf_counter()
            write_task(info, index, values, {"bounded": plan.cells_in(index)})
            taken.append(time.perf_counter() - started)
            if sum(taken) > WRITING_S:
                break
    return float(np.median(taken))


def wall_seconds(core_seconds: float, n_tasks: int, workers: int) -> float:
    """Convert the time that a run takes on one core to the time with a number of threads or workers [s].

    Parameters
    ----------
    core_seconds
        Time on one core, with writing [s].
    n_tasks
        Number of tasks that are left.
    workers
        Number of threads or workers; 0 stands for the calling thread.
    """
    return core_seconds / max(1, min(workers, n_tasks))


def _sample(plan: Plan, rng: np.random.Generator, n_branches: int, *, pairs: bool) -> Inputs:
    """Draw cells at random from the whole run; return their parameters, frequencies and initial states.

    With `pairs`, the points of a continuation's branch come in neighbouring pairs, so that the second point
    of a pair starts where it would start in the run.
    """
    n_points = plan.n_points
    in_task = math.prod(n for i, n in enumerate(plan.block) if i != plan.path)
    branches = [n for i, n in enumerate(plan.shape) if i != plan.path]
    chosen = rng.choice(math.prod(branches), min(n_branches, in_task, math.prod(branches)), replace=False)
    parts = []
    for flat in np.sort(chosen):
        place = list(np.unravel_index(flat, branches)) if branches else []
        block = [slice(int(i), int(i) + 1) for i in place]
        if plan.path is not None:
            block.insert(plan.path, slice(0, n_points))
        parts.append(plan.cells.inputs(tuple(block)))
    points = _points(n_points, rng, pairs=pairs)
    return Inputs(
        np.concatenate([p.parameters[:, points] for p in parts]),
        np.concatenate([p.frequency_hz[:, points] for p in parts]),
        np.concatenate([p.initial_states for p in parts]),
    )


def _points(n_points: int, rng: np.random.Generator, *, pairs: bool) -> np.ndarray:
    """Draw random points along the axis of a continuation, single or in adjacent pairs."""
    n_parts = min(POINTS, n_points // 2 if pairs and n_points > 1 else n_points)
    edges = np.linspace(0, n_points, n_parts + 1)
    first = np.array([rng.integers(math.ceil(a), math.ceil(b)) for a, b in itertools.pairwise(edges)])
    if not pairs or n_points == 1:
        return first
    first = np.minimum(first, n_points - 2)
    return np.stack([first, first + 1], axis=1).ravel()


def _speed(spec: Spec, inputs: Inputs, most: float) -> tuple[float, int, float]:
    """Measure how long sampled cells take, relative to a rule of thumb.

    Two stretches are measured: one from the initial states, and one from the end of the first, which
    represents the rest of the cell. A few periods before them tell how many fit into the time.
    """
    stretch_s = 0.1  # time of each of the two stretches in which the speed is measured [s]
    few = int(min(LEAST_PERIODS, most))
    _, first, seconds = _stretch(spec, inputs, few)
    if seconds > 5 * stretch_s:  # so slow that these must suffice
        return first, few, seconds
    n_periods = int(min(max(few * stretch_s / seconds, few), most)) if seconds else few
    ends, first, first_s = _stretch(spec, inputs, n_periods)
    _, later, later_s = _stretch(spec, replace(inputs, initial_states=ends), n_periods)
    share = n_periods / most
    return share * first + (1 - share) * later, 2 * n_periods, first_s + later_s


def _stretch(spec: Spec, inputs: Inputs, n_periods: int) -> tuple[np.ndarray, float, float]:
    """Integrate sampled cells over some periods, and measure the processor time that this takes.

    The time is processor time, so that other programs do not count.
    """
    from pipeline.compute.integrate import integrate

    never = 1e-300
    # a tolerance that no cell meets, since an integration without the test would need another kernel
    integration = spec.integration.model_copy(
        update={"n_transient": n_periods - 1, "n_keep": 1, "closure_tolerance": never}
    )
    started = time.process_time()
    values = integrate(spec.replace(integration=integration), inputs)
    seconds = time.process_time() - started
    ends = values["section"][:, -1, -1]
    a_period = spec.motion.seconds_per_period(inputs.frequency_hz)
    # a flow that does not return waits for as long as it may
    by_rule = float((a_period * np.maximum(values["n_periods"], 1)).sum())
    return np.where(np.isfinite(ends), ends, inputs.initial_states), seconds / by_rule, seconds


def _periods_until_closed(plan: Plan, most: float, ratio: float) -> float:
    """Estimate from a sample how many periods a cell takes on average, if its integration stops once its orbit has
    closed.

    A first sample gives the number of cells for which there is time.
    """
    from pipeline.compute.integrate import integrate

    closing_s = 0.4  # most time for measuring when cells close, by the rule of thumb [s]
    spec, rng, n_keep = plan.spec, np.random.default_rng(1), plan.spec.integration.n_keep
    found, n_branches, left = np.empty(0), BRANCHES, closing_s
    while left > 0:
        inputs = _sample(plan, rng, n_branches, pairs=True)
        a_period = ratio * float(spec.motion.seconds_per_period(inputs.frequency_hz).mean())
        if not len(found):
            cap = int(min(most, max(closing_s / (a_period * inputs.frequency_hz.size), n_keep + LEAST_PERIODS)))
            integration = spec.integration.model_copy(update={"n_transient": cap - n_keep})
        started = time.process_time()
        values = integrate(spec.replace(integration=integration), inputs)
        left -= time.process_time() - started
        periods = values["n_periods"]
        found = np.append(found, periods[:, 1::2] if periods.shape[1] > 1 else periods)
        per_branch = float(found.mean()) * a_period * periods.shape[1]
        n_branches = int(np.clip(left / per_branch, 1, MOST_SAMPLED_BRANCHES))
        if len(found) >= plan.n_cells or n_branches < BRANCHES:
            break
    return mean_with_tail(found, cap, most)


def mean_with_tail(periods: np.ndarray, cap: float, most: float) -> float:
    """Return the mean number of periods per trajectory, with an estimate for those that were stopped after `cap`
    periods.

    These cells are assumed to end at the rate at which cells ended in the second half of the observed
    periods.
    """
    open_half, still_open = int((periods > cap / 2).sum()), int((periods >= cap).sum())
    if not still_open or most <= cap:
        return float(periods.mean())
    rate = math.log(open_half / still_open) / (cap / 2)
    more = most - cap
    extra = more if rate == 0 else -math.expm1(-rate * more) / rate
    return float(periods.mean() + extra * still_open / len(periods))
