"""Check the steps of a noisy run: refuse them before it begins if they are too long, and warn at its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pipeline.layout.plan import Plan
from pipeline.motion.noisy import Noisy
from pipeline.motion.steady import Inputs
from pipeline.specification.noise import STEPS_PER_PERIOD, NoiseTable
from pipeline.specification.problems import SpecError
from pipeline.store.run import RunDirectory

SAMPLE, PERIODS = 32, 4
"""Cells and periods of the sample that is integrated before a run begins."""

STABLE = 2.5
"""Largest step times rate of contraction at which the method is stable: 2.51 for its three stages of order 3."""

ORDER, ORDER_OF_OWN = 1.5, 1.0
"""Strong order of the method, and where a strength depends on its own state: for the step that a message proposes."""


def check_steps(plan: Plan) -> None:
    """Refuse a run with noise whose steps are too long for a layer of its equations or for its tolerance.

    `SAMPLE` cells, evenly spread over the run, are integrated for some periods. The run is refused if the largest
    of their strong errors is above ``noise.tolerance``, or if a step is longer than the equations can be
    followed at their fastest contraction (`magpend_core.stiffness`).

    Raises
    ------
    SpecError
        With the step's length, the bound and the number of steps that fits.
    """
    spec, motion = plan.spec, plan.spec.motion
    if not isinstance(motion, Noisy):
        return
    inputs = plan.cells.spread(SAMPLE)
    if problem := _stiff_problem(motion, inputs):
        raise SpecError([problem])
    few = min(PERIODS, spec.integration.n_transient + spec.integration.n_keep)
    short = spec.integration.model_copy(update={"n_transient": few - 1, "n_keep": 1})
    error = replace(motion, integration=short).integrate(inputs, None)[1]["strong_error"]
    largest = float(np.nanmax(error)) if np.isfinite(error).any() else 0.0
    tolerance = motion.table.tolerance
    if largest > tolerance:
        order = ORDER_OF_OWN if any(motion.path["noise"].own) else ORDER
        factor = (1.2 * largest / tolerance) ** (1.0 / order)
        raise SpecError(
            [
                f"noise.{_step_key(motion.table)}: halving the steps changes a state within a period by {largest:.2g} "
                f"of its scale, more than noise.tolerance = {tolerance:g}; set {_remedy(motion.table, factor)}."
            ]
        )


def warn_of_steps(run: RunDirectory, echo: Callable[[str], None]) -> None:
    """Print a warning if cells of a finished run have a strong error above ``noise.tolerance``."""
    motion = run.spec.motion
    if not isinstance(motion, Noisy):
        return
    error, tolerance = run.cube()["strong_error"].values, motion.table.tolerance
    n_above, n = int((error > tolerance).sum()), int(np.isfinite(error).sum())
    if n_above:
        echo(
            f"warning: in {n_above} of {n} cells the last period changes by more than noise.tolerance = "
            f"{tolerance:g} when its steps are halved (at most {np.nanmax(error):.2g}); take shorter steps."
        )


def _stiff_problem(motion: Noisy, inputs: Inputs) -> str | None:
    from magpend_core.stiffness import fastest_contraction

    given = inputs.parameters[:, 0], inputs.frequency_hz[:, 0], inputs.initial_states
    rate = fastest_contraction(motion.model.system, *given)
    longest = float((1.0 / inputs.frequency_hz[:, 0] / motion.steps(inputs)).max())
    if not longest * rate > STABLE:
        return None
    bound = STABLE / rate
    return (
        f"noise.{_step_key(motion.table)}: a step has {longest:.3g} s, and the equations contract at {rate:.4g} /s in "
        f"a layer; steps must be shorter than {bound:.3g} s. Set {_remedy(motion.table, 1.05 * longest / bound)}."
    )


def _step_key(noise: NoiseTable) -> str:
    if noise.step is not None:
        return f"step = {noise.step:g}"
    return f"steps_per_period = {noise.steps_per_period or STEPS_PER_PERIOD}"


def _remedy(noise: NoiseTable, factor: float) -> str:
    """Return the key and value with steps shorter by a factor."""
    if noise.step is not None:
        return f"step = {noise.step / factor:.2g}"
    return f"steps_per_period = {int(np.ceil((noise.steps_per_period or STEPS_PER_PERIOD) * factor))}"
