"""Decide the method of a run for which none is chosen, before it begins.

Where accuracy limits the steps of an explicit method of order 5, a tolerance that is 1000 times as large leaves a
quarter of them; where stability limits them, nearly all. A few cells of the run are therefore integrated for a few
periods at both tolerances, with the code that the run needs anyway. Their counts give the steps that accuracy asks
for, about as many as a stiff method needs. Only if these would cost less than the explicit steps, the stiff method is
compiled, and its steps are counted, too.

Counts of steps have the same bits everywhere, so that no decision depends on the machine, on threads or on tasks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from magpend_core.defaults import MOST_STEPS
from magpend_core.status import Status
from pipeline.layout.plan import Plan
from pipeline.motion.steady import Inputs
from pipeline.runs.progress import duration
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.specification.tables import EXPLICIT, STIFF

PROBED_CELLS, PROBED_PERIODS = 8, 4
"""Most cells that are integrated for a decision, and most of their periods."""

LOOSER, LOOSEST = 1e3, 1e-2
"""Factor between the two tolerances, and the largest one; above it the second one is finer than the run's instead."""

ORDER_OF_EXPLICIT = 5
"""Order of the explicit method: its steps are in proportion to the root of this order of 1/tolerance."""

HARDLY = 2.0
"""Ratio of the steps at both tolerances below which they hardly differ; the law of accuracy gives 4."""

LEAST_STEPS = 4
"""Steps that a stiff method takes in a period at any tolerance."""

CHEAPER_BY = 1.5
"""Factor by which the stiff method must be cheaper, since estimates are rough."""

SHARES = (0.2, 0.4, 0.6, 0.8)
"""Parts of a period's steps after which the states are looked at."""

LEAST_RADIUS = 1.0
"""Mean step times spectral radius below which stability does not limit the steps: at the limit it is above 3."""


def cost_of_stiff_step(n_states: int) -> float:
    """Return the time of an attempted step of the stiff method, in attempted steps of the explicit one.

    Measured on rings of van der Pol oscillators: 1.6 to 2.2 for 2 and 4 states, 2.2 to 3.2 for 8, 4 to 7 for 16, 8 to
    20 for 32, 9 to 33 for 64, the more the denser the Jacobian is. It is rounded up for few states.
    """
    return 2.0 + n_states / 4.0


@dataclass(frozen=True)
class Decision:
    """The method that is decided for a run, and why."""

    method: str
    reason: str


@dataclass(frozen=True)
class _Count:
    """Steps of some cells, shape (cell,)."""

    attempts: np.ndarray  # attempted steps
    periods: np.ndarray  # periods that are complete
    seconds: np.ndarray  # their time [s]
    status: np.ndarray
    last: np.ndarray  # last states, shape (cell, state)

    @property
    def is_known(self) -> np.ndarray:
        """Mask of the cells that tell: those that went on to the end, or to the limit of steps."""
        return np.isin(self.status, (Status.PERIODIC, Status.BOUNDED, Status.STEP_LIMIT, Status.NO_RETURN))

    @property
    def is_limited(self) -> np.ndarray:
        """Mask of the cells that met the limit of steps."""
        return np.asarray(self.status == Status.STEP_LIMIT)

    def take(self, cells: np.ndarray) -> _Count:
        """Return the counts of selected cells."""
        return _Count(*(values[cells] for values in vars(self).values()))


def decided(plan: Plan, echo: Callable[[str], None]) -> Plan:
    """Return the plan with the method of its run. Where that is not chosen it is decided, and told by `echo`."""
    if not plan.undecided:
        return plan
    compile_kernel(plan, echo)
    found = decide(plan, echo)
    echo(f"method: {found.method} (auto: {found.reason})")
    return replace(plan, spec=plan.spec.by_method(found.method), undecided=False)


def check_method(spec: Spec) -> None:
    """Refuse the stiff method for a system that it cannot integrate.

    Raises
    ------
    SpecError
        With the reason.
    """
    if spec.integration.method != STIFF:
        return
    from magpend_core.engine.symbolic import implicit_problem

    if problem := implicit_problem(spec.motion.system):
        raise SpecError(f'integration.method = "{STIFF}": {problem}')


def compile_kernel(plan: Plan, echo: Callable[[str], None]) -> None:
    """Compile what a run needs, which also checks its model; do nothing for what is compiled already."""
    from pipeline.compute import task

    seconds = task.warm_up(plan)
    if seconds > 1:
        echo(f"kernel compiled in {duration(seconds)}")


def decide(plan: Plan, echo: Callable[[str], None]) -> Decision:
    """Decide the method of a run from cells that are spread over it. If the stiff one is compiled, `echo` tells it."""
    spec, inputs = plan.spec, plan.cells.spread(PROBED_CELLS)
    exact = _count(spec, inputs)
    if not exact.is_known.any():  # coarse explicit steps may lose a stiff motion
        spec = _at(spec, 1.0 / LOOSER)
        exact = _count(spec, inputs)
    inputs, exact = inputs.take(exact.is_known), exact.take(exact.is_known)
    if not len(exact.status):
        return Decision(EXPLICIT, "no cell tells how long its steps can be")
    if not _looks_stiff(spec, inputs, exact):
        return Decision(EXPLICIT, "accuracy limits its steps")
    plan = replace(plan, spec=spec.by_method(STIFF))
    try:
        compile_kernel(plan, echo)
    except ValueError as error:
        return Decision(EXPLICIT, f"{STIFF} does not suit: {str(error).rstrip('.')}")
    return _cheaper(exact, _count(plan.spec, inputs), cost_of_stiff_step(len(spec.model.states)))


def _cheaper(explicit: _Count, stiff: _Count, cost: float) -> Decision:
    """Decide between the methods by the steps that they take for the same cells."""
    if (stiff.is_limited & ~explicit.is_limited).any() or not stiff.is_known.all():
        return Decision(EXPLICIT, f"{STIFF} loses cells")
    many, few = int(explicit.attempts.sum()), int(stiff.attempts.sum())
    more = "more than " if explicit.is_limited.any() else ""
    is_stiff = many > CHEAPER_BY * cost * few or bool((explicit.is_limited & ~stiff.is_limited).any())
    method = STIFF if is_stiff else EXPLICIT
    steps = f"{few} steps of {STIFF}, each as long as {cost:.1f}, do what takes {more}{many} of {EXPLICIT}"
    return Decision(method, steps)


def _at(spec: Spec, scale: float) -> Spec:
    """Return a specification with scaled tolerances."""
    own = spec.integration
    scaled = {"rtol": max(own.rtol * scale, 1e-13), "atol": own.atol * scale}
    return spec.replace(integration=own.model_copy(update=scaled))


def _count(spec: Spec, inputs: Inputs, scale: float = 1.0, limit: int = MOST_STEPS) -> _Count:
    """Integrate cells for some periods at scaled tolerances, and count their steps."""
    from pipeline.compute.integrate import watched_quantities

    own = _at(spec, scale).integration
    n = min(PROBED_PERIODS, own.n_transient + own.n_keep)
    never = 1e-300  # a tolerance that no orbit meets
    changed = {
        "n_transient": 0,
        "n_keep": n,
        "max_steps_per_period": min(own.max_steps_per_period, limit),
        "closure_tolerance": never,
    }
    spec = spec.replace(integration=own.model_copy(update=changed))
    cells, _ = spec.motion.integrate(inputs, watched_quantities(spec))
    periods = cells.n_periods[:, 0]
    seconds = periods / inputs.frequency_hz[:, 0]
    if cells.return_time is not None:
        returned = np.nansum(cells.return_time[:, 0], axis=1)
        seconds = np.where(cells.status[:, 0] == Status.NO_RETURN, returned + 1.0 / inputs.frequency_hz[:, 0], returned)
    attempts = (cells.n_steps + cells.n_rejected)[:, 0].astype(np.int64)
    return _Count(attempts, periods, seconds, cells.status[:, 0], cells.final_state[:, 0])


def _looks_stiff(spec: Spec, inputs: Inputs, exact: _Count) -> bool:
    """Return whether other limits than accuracy make the steps so short that the stiff method may be cheaper.

    There are two signs: so few steps change with the tolerance by the law of accuracy that as many stiff ones would be
    cheaper; or the whole count hardly changes, as it also does where layers limit steps.
    """
    is_coarse = max(spec.integration.rtol, spec.integration.atol) * LOOSER > LOOSEST
    factor = 1.0 / LOOSER if is_coarse else LOOSER
    other = _count(spec, inputs, factor)
    if factor > 1.0 and not other.is_known.all():  # coarse steps may lead elsewhere
        factor = 1.0 / LOOSER
        other = _count(spec, inputs, factor)
    known = other.is_known
    inputs, exact, other = inputs.take(known), exact.take(known), other.take(known)
    changed = (exact.attempts - other.attempts) / (1.0 - factor ** (-1.0 / ORDER_OF_EXPLICIT))
    by_accuracy = np.maximum(changed, 0.0) + LEAST_STEPS * (exact.periods + 1)
    cost = cost_of_stiff_step(len(spec.model.states))
    few, many = sorted((exact.attempts.sum(), other.attempts.sum()))
    hardly = many < HARDLY * few and not spec.motion.system.has_layers
    seems = hardly or exact.attempts.sum() > CHEAPER_BY * cost * by_accuracy.sum()
    return bool(known.any() and seems) and _at_stability_limit(spec, inputs, exact)


def _at_stability_limit(spec: Spec, inputs: Inputs, exact: _Count) -> bool:
    """Return whether steps are as long as the spectral radius of the Jacobian lets an explicit method take.

    It tells them from the short steps at edges, layers and impacts, which do not change with the tolerance either.
    """
    from magpend_core.stiffness import spectral_radii

    system = spec.motion.system
    if system.jacobian is None or exact.is_limited.any():
        return True
    longest = (exact.attempts / np.maximum(exact.periods, 1)).max()
    radii = []
    for share in SHARES:
        states = _count(spec, inputs, limit=max(1, int(share * longest))).last
        radii.append(spectral_radii(system, inputs.parameters[:, 0], inputs.frequency_hz[:, 0], states))
    return bool((np.mean(radii, axis=0) * exact.seconds / exact.attempts).max() > LEAST_RADIUS)
