"""Find the step in which a noisy trajectory first leaves a region, for each SIMD lane.

A path can leave a region and come back within a step. Between the ends of a step it is taken as a Brownian bridge
with the strengths at the step's begin: beyond a flat face at the distances a and b from the two ends it has been
with the probability exp(-2 a b/(s**2 h)), where s is the strength along the face's normal and h the step. A random
number of the step's own decides. The mean time of passage then has an error of the order of the step; that of a test
at the ends alone is of the order of its square root. E. Gobet, Weak approximation of killed diffusion using Euler
schemes, Stochastic Process. Appl. 87 (2000) 167-197; of curved faces, Euler schemes and half-space approximation for
the simulation of diffusion in a domain, ESAIM: Probab. Stat. 5 (2001) 261-297.

The functions below `Region` are templates, bound to a system by `noisy.noisy_engine_of` with the observer `PASSAGE`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from magpend_core.engine.jit import bound_part, inline
from magpend_core.engine.noise import Noise
from magpend_core.engine.observers import BOUNDED, PENDING, Observer
from magpend_core.engine.random_numbers import tag_word, uniform_pair
from magpend_core.engine.simd import WIDTH, floor, load, maximum, minimum, sqrt, store, where_less
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import TWO_PI, exp

INFINITE = np.inf
TINY = 1e-300
LEAVING = 2
"""Purpose of the random number of a step that decides whether the path left within it; see `noisy.PATH`."""
WHOLE, FIRST_HALF, SECOND_HALF = 0, 1, 2
"""Which part of a step is made."""


class Region(NamedTuple):
    """Box and ball in state space, for each cell; a state is inside if it is in both.

    Distances from the centre are signed and, for angles, at most half a turn.
    """

    centre: np.ndarray  # (cell, n_states)
    low: np.ndarray  # (cell, n_states): least distance from the centre, -inf for none
    high: np.ndarray  # (cell, n_states)
    weight: np.ndarray  # (cell, n_states): of a distance in the ball's radius
    radius: np.ndarray  # (cell, 1): inf for no ball

    def contains(self, states: np.ndarray, is_angle: tuple[bool, ...]) -> np.ndarray:
        """Return which states, shape (cell, n_states), are inside."""
        away = states - self.centre
        away = np.where(is_angle, away - TWO_PI * np.floor(away / TWO_PI + 0.5), away)
        boxed = ((away >= self.low) & (away <= self.high)).all(axis=1)
        return np.asarray(boxed & (((self.weight * away) ** 2).sum(axis=1) <= self.radius[:, 0] ** 2))


class PassageSettings(NamedTuple):
    """Setting of the observer `PASSAGE`."""

    n_periods: int


def _end(
    section: Any, turns: Any, i_period: int, memory: Any, record: Any, measures: Any, settings: PassageSettings
) -> int:
    """End a trajectory that has not left after a number of periods."""
    return BOUNDED if i_period >= settings.n_periods else PENDING


@inline
def _memory_size(settings: PassageSettings, n_states: int) -> int:
    return 0


PASSAGE = Observer("passage", _end, _memory_size, {"BOUNDED": BOUNDED, "PENDING": PENDING})
"""Observer that keeps nothing; with it the engine ends a cell in the period in which it leaves its region.

The measures of a cell are the number of steps until it leaves, counted from the begin of its first period ever and
infinite if it stays, and the state at the end of that step.
"""


def away(w: Any, base: int, row: int, i: int) -> Any:
    """Return the distance from the region's centre of state `i` in the rows that begin at `row`."""
    x = load(w, row + i * WIDTH) - load(w, base + ROWS.centre + i * WIDTH)
    if IS_ANGLE[i] == 1:
        x = x - TWO_PI * floor(x * (1.0 / TWO_PI) + 0.5)
    return x


def stays(before: Any, after: Any, variance: Any) -> Any:
    """Return the probability that a bridge between two distances from a face has not passed the face."""
    inside = 1.0 - exp(-2.0 * (before * after) / maximum(variance, TINY))
    return where_less(0.0, minimum(before, after), inside, 0.0 * variance)


def hold(w: Any, base: int) -> None:
    """Keep the states and the strengths at the begin of a step."""
    for i in range(N):
        store(w, base + ROWS.begin + i * WIDTH, load(w, base + ROWS.state + i * WIDTH))
    for j in range(N_SOURCES):
        store(w, base + ROWS.held_strength + j * WIDTH, load(w, base + ROWS.strength + j * WIDTH))


def probability_of_staying(w: Any, base: int, h: Any) -> Any:
    """Return the probability that a path has been in its region all through a step that was made."""
    zero = 0.0 * h
    held, ball_before, ball_after, across = zero + 1.0, zero, zero, zero
    for i in range(N):
        row = base + i * WIDTH
        before, after = away(w, base, base + ROWS.begin, i), away(w, base, base + ROWS.state, i)
        variance = zero
        if SOURCE_OF[i] >= 0:
            strength = load(w, base + ROWS.held_strength + SOURCE_OF[i] * WIDTH)
            variance = h * (strength * strength)
        low, high = load(w, row + ROWS.low_face), load(w, row + ROWS.high_face)
        held = held * (stays(before - low, after - low, variance) * stays(high - before, high - after, variance))
        weight = load(w, row + ROWS.weight)
        before, after = weight * before, weight * after
        ball_before, ball_after = ball_before + before * before, ball_after + after * after
        across = across + (weight * weight) * (variance * (after * after))
    radius = load(w, base + ROWS.radius)
    across = across / maximum(ball_after, TINY)
    return held * stays(radius - sqrt(ball_before), radius - sqrt(ball_after), across)


def watch(w: Any, base: int, h: Any, keys: Any, part: int) -> None:
    """Note in which lanes a path has left its region in the step that was made, if it had not left before."""
    count = load(w, base + ROWS.total)
    first, second = uniform_pair(count, load(w, base + ROWS.low), load(w, base + ROWS.high), PASSAGE_TAG, keys)
    drawn, ended = first, count + 1.0
    if part == FIRST_HALF:
        ended = count + 0.5
    if part == SECOND_HALF:
        drawn = second
    time = where_less(probability_of_staying(w, base, h), drawn, ended, 0.0 * h + INFINITE)
    passed = load(w, base + ROWS.passed)
    for i in range(N):
        row = base + i * WIDTH
        place = where_less(time, passed, load(w, row + ROWS.state), load(w, row + ROWS.place))
        store(w, row + ROWS.place, place)
    store(w, base + ROWS.passed, minimum(time, passed))


def watched_step(w: Any, base: int, time: Any, h: Any, root: Any, keys: Any, part: int) -> None:
    """Make a step or half a step; with the observer `PASSAGE`, find where the path left its region in it."""
    if PASSES:
        hold(w, base)
    step(w, base, time, h, root)
    if PASSES:
        watch(w, base, h, keys, part)


def begin_watch(cells: Any, cell: int, w: Any, base: int, column: int) -> None:
    """Load a cell's region into a SIMD lane."""
    region = cells.region
    for i in range(N):
        row = base + i * WIDTH + column
        w[row + ROWS.centre] = region.centre[cell, i]
        w[row + ROWS.low_face] = region.low[cell, i]
        w[row + ROWS.high_face] = region.high[cell, i]
        w[row + ROWS.weight] = region.weight[cell, i]
        w[row + ROWS.place] = np.nan
    w[base + ROWS.radius + column] = region.radius[cell, 0]
    w[base + ROWS.passed + column] = INFINITE


def note_passage(cells: Any, cell: int, w: Any, base: int, column: int) -> int:
    """Write the passage of a lane whose period has ended; return ``BOUNDED`` if there was one, else ``PENDING``."""
    cells.measures[cell, 0] = w[base + ROWS.passed + column]
    for i in range(N):
        cells.measures[cell, 1 + i] = w[base + ROWS.place + i * WIDTH + column]
    return BOUNDED if cells.measures[cell, 0] < INFINITE else PENDING


def passage_bindings(system: System, noise: Noise, bindings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of further free names of the noisy engine, the templates of this module included."""
    found: dict[str, Any] = {
        "SOURCE_OF": np.array([noise.states.index(i) if i in noise.states else -1 for i in range(system.n_states)]),
        "PASSAGE_TAG": tag_word(0, LEAVING),
    }
    for template in (away, stays, hold, probability_of_staying, watch, begin_watch, note_passage):  # callees first
        found[template.__name__] = bound_part(template, {**bindings, **found}, template in (away, stays))
    return found
