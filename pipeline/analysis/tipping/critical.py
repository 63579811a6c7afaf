"""Bisect the value of a swept number at which trajectories end on another attractor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from magpend_core import Status
from pipeline.analysis.outcomes import DIVERGED
from pipeline.analysis.run import OpenRun
from pipeline.analysis.tipping.endings import NONE, Final, Group, endings, finals_of
from pipeline.layout.cells import initial_states
from pipeline.motion.drifting import Drifting
from pipeline.products.reporting import report
from pipeline.products.tipping import TippingOptions
from pipeline.specification.tables import FREQUENCY

if TYPE_CHECKING:
    from magpend_core import Sections

MOST_STEPS = 60
"""Most bisections; float64 has 53 binary digits."""

MOST_KNOWN = 3
"""Cells of each attractor that go on beside those that are examined."""


@dataclass(frozen=True)
class Bracket:
    """An interval of a swept number, at whose ends a trajectory ends on different attractors.

    Attributes
    ----------
    start : int
        Number of the initial condition.
    point : tuple of float
        Values of the other axes.
    low, high : float
        Ends of the interval.
    outcome_low, outcome_high : int
        Attractors at the ends, or `DIVERGED`.
    n_evaluated : int
        Trajectories integrated by the bisection.
    is_decided : bool
        False if the bisection met a trajectory whose attractor could not be found.
    """

    start: int
    point: tuple[float, ...]
    low: float
    high: float
    outcome_low: int
    outcome_high: int
    n_evaluated: int = 0
    is_decided: bool = True

    def halved(self, middle: float, outcome: int) -> Bracket:
        """Return the half at whose ends the outcomes differ, the lower one if both do."""
        n = self.n_evaluated + 1
        if outcome == NONE:
            return replace(self, n_evaluated=n, is_decided=False)
        if outcome == self.outcome_low:
            return replace(self, low=middle, n_evaluated=n)
        return replace(self, high=middle, outcome_high=outcome, n_evaluated=n)


def brackets_of(values: np.ndarray, outcomes: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of neighbouring known outcomes that differ, as indices of the swept values.

    Parameters
    ----------
    values
        Of the swept number, rising, shape (n,).
    outcomes
        At these values, shape (n,); `NONE` where nothing is known.
    """
    known = np.flatnonzero(outcomes != NONE)
    pairs = zip(known[:-1].tolist(), known[1:].tolist(), strict=True)
    return [(a, b) for a, b in pairs if outcomes[a] != outcomes[b]]


class Bisection:
    """A bisection of many brackets at the same time.

    Parameters
    ----------
    run
        Run whose parameters move.
    axis
        Name of the swept number.
    others
        Names of the other swept parameters, in the order of `Bracket.point`.
    groups
        What is known of the run's own cells, see `endings`.
    ids
        For each group the numbers that its attractors have in the brackets.
    options
        Width and lengths.
    """

    def __init__(
        self,
        run: OpenRun,
        axis: str,
        others: tuple[str, ...],
        groups: list[Group],
        ids: list[dict[int, int]],
        options: TippingOptions,
    ) -> None:
        self.run, self.axis, self.others, self.options = run, axis, others, options
        self.starts = initial_states(run.spec.initial_conditions)
        span = run.spec.axes[axis].array()
        self.width = options.width * float(np.ptp(span))
        self.known = {
            group.final.key: (group.final, *_examples(group, own)) for group, own in zip(groups, ids, strict=True)
        }

    def run_all(self, brackets: list[Bracket]) -> list[Bracket]:
        """Return the brackets, halved until they are narrow enough or cannot be decided."""
        found = list(brackets)
        for step in range(MOST_STEPS):
            open_ = [i for i, b in enumerate(found) if self._is_open(b)]
            if not open_:
                break
            report("bisecting", step, MOST_STEPS)
            middles = np.array([0.5 * (found[i].low + found[i].high) for i in open_])
            outcomes = self._outcomes([found[i] for i in open_], middles)
            for i, middle, outcome in zip(open_, middles.tolist(), outcomes.tolist(), strict=True):
                found[i] = found[i].halved(middle, outcome)
        return found

    def _is_open(self, bracket: Bracket) -> bool:
        middle = 0.5 * (bracket.low + bracket.high)
        is_wide = bracket.high - bracket.low > self.width and bracket.low < middle < bracket.high
        return bracket.is_decided and is_wide

    def _outcomes(self, brackets: list[Bracket], middles: np.ndarray) -> np.ndarray:
        """Return the attractors that trajectories reach with given values of the swept number."""
        spec = self.run.spec
        names = spec.values.names
        packed = np.tile(spec.values.pack(), (len(brackets), 1))
        frequency = np.full(len(brackets), np.nan if spec.frequency_hz is None else spec.frequency_hz)
        for i, bracket in enumerate(brackets):
            here = {self.axis: middles[i], **dict(zip(self.others, bracket.point, strict=True))}
            frequency[i] = here.pop(FREQUENCY, frequency[i])
            for name, value in here.items():
                packed[i, names.index(name)] = value
        starts = self.starts.at(np.array([b.start for b in brackets]))
        found = drifted(self.run, packed, frequency, starts)
        finals = finals_of(spec, packed, frequency)
        return self._compared(finals, found.final_state[:, 0], found.status[:, 0])

    def _compared(self, finals: list[Final], states: np.ndarray, status: np.ndarray) -> np.ndarray:
        """Return the known attractors on which cells end; cells of each known attractor go on beside them."""
        outcome = np.full(len(finals), NONE)
        outcome[status == Status.DIVERGED] = DIVERGED
        keys = [final.key for final in finals]
        for key in dict.fromkeys(keys):
            own = np.flatnonzero([k == key for k in keys])
            if key not in self.known:
                continue
            final, examples, labels = self.known[key]
            n = len(examples)
            both = np.concatenate([examples, states[own]])
            codes = np.concatenate([np.full(n, int(Status.BOUNDED)), status[own]])
            (group,) = endings(self.run, [final] * len(both), both, codes, self.options)
            names = {int(o): int(label) for o, label in zip(group.outcome[:n], labels, strict=True) if o >= 0}
            names[DIVERGED] = DIVERGED
            outcome[own] = [names.get(int(o), NONE) for o in group.outcome[n:]]
        return outcome


def _examples(group: Group, ids: dict[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return states on each attractor of a group, and the attractors' numbers."""
    states, labels = [np.zeros((0, group.settled.shape[1]))], []
    own = group.outcome[np.searchsorted(group.cells, group.integrated)]
    for local, number in ids.items():
        chosen = np.flatnonzero(own == local)[:MOST_KNOWN]
        states.append(group.settled[chosen])
        labels += [number] * len(chosen)
    return np.concatenate(states), np.array(labels, np.int64)


def drifted(run: OpenRun, packed: np.ndarray, frequency_hz: np.ndarray, starts: np.ndarray) -> Sections:
    """Integrate cells of a run over its whole length, with other parameters; only the last section is kept."""
    motion, integration = run.spec.motion, run.spec.integration
    assert isinstance(motion, Drifting)
    length = {"n_transient": integration.n_transient + integration.n_keep - 1, "n_keep": 1}
    return motion.sections(packed, frequency_hz, starts, **length, max_orbit_period=1)
