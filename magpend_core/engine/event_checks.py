"""Check the switches and impacts of a system against their declaration; see `checks`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from magpend_core.engine.system import System

STEP = 1e-5
"""Time step of the finite differences along the motion, in periods or in units of its shortest time scale."""

WRONG = 1e-3
"""Smallest relative error of a rate that is reported."""


def declaration(system: System) -> Iterator[str]:
    """Yield the problems in a system's plain fields for switches and impacts."""
    least = system.n_switches + system.n_contacts + system.has_segments
    if system.n_modes != least:
        yield (
            f"n_modes = {system.n_modes}; it must be {least}: one for each of the {system.n_switches} "
            f"switches, one for each of the {system.n_impacts} impacts if any sticks, and one more if "
            "has_segments."
        )
    for field, n, of in (
        ("slides", system.n_switches, "switches"),
        ("impact_directions", system.n_impacts, "impacts"),
        ("sticks", system.n_impacts, "impacts"),
    ):
        if len(getattr(system, field)) != n:
            given = len(getattr(system, field))
            yield f"{field} has {given} entries; it must have one for each of the {n} {of}."
    for name, needed in (("switches", system.n_switches), ("impacts", system.n_impacts), ("reset", system.n_impacts)):
        if needed and getattr(system, name) is None:
            yield f"{name} is missing."
    if system.section is not None and system.section[0] is None and system.surface is None:
        yield "surface is missing; the section is of no state."
    for direction in system.impact_directions:
        if direction not in (1, -1):
            yield f"impact_directions: {direction} must be 1 (rising) or -1 (falling)."
    if system.has_segments and not system.n_edges:
        yield "has_segments is set, and n_edges = 0: there is no edge that could begin a segment."


def modes_at(system: System, times: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the modes used in checks at given times: switches at +1, no contact, and the number of forcing edges
    passed.
    """
    modes = [np.ones(len(times))] * (system.n_switches + system.n_contacts)
    if system.has_segments:
        modes.append(np.searchsorted(edges[0], times, side="right").astype(np.float64))
    return tuple(modes)


def motion_problems(motion: Any, rates: np.ndarray) -> None:
    """Check the event functions and impact maps at the samples of `checks._Motion`, and append the problems."""
    system, functions = motion.system, motion.functions
    surfaces = int(system.surface is not None)
    for name, n in (("switches", system.n_switches), ("impacts", system.n_impacts), ("surface", surfaces)):
        if n:
            _check_pairs(motion, name, n, rates)
    for k in range(system.n_impacts + system.n_contacts):
        names = ", ".join(system.state_names)
        c = (float(np.broadcast_to(x, motion.times.shape)[0]) for x in motion.c)
        arguments = (k, float(motion.times[0]), tuple(map(float, motion.y[:, 0])), tuple(c))
        functions.numbers("reset", system.n_states, f"the states after impact {k} ({names})", *arguments)


def _values(motion: Any, name: str, n: int, time: Any, y: np.ndarray, rates: np.ndarray) -> np.ndarray | None:
    """Return values and time derivatives of event functions at the samples, shape (n, 2, sample)."""
    found = motion.functions.call(name, time, tuple(y), tuple(rates), motion.c)
    if not isinstance(found, tuple):
        return None
    shape = motion.y.shape[1]
    return np.array([[np.broadcast_to(x, shape) for x in pair] for pair in found[:n]])


def _check_pairs(motion: Any, name: str, n: int, rates: np.ndarray) -> None:
    problems = motion.functions.problems
    before = len(problems)
    found = motion.functions.call(name, motion.times, tuple(motion.y), tuple(rates), motion.c)
    if len(problems) > before or not isinstance(found, tuple | list):
        return
    if len(found) != n or not all(isinstance(x, tuple) and len(x) == 2 for x in found):
        problems.append(f"{name} must return a tuple of {n} pairs (value, rate).")
        return
    good = np.isfinite(rates).all(axis=0)
    size = np.abs(rates[:, good]) / motion.scales[:, None]
    step = STEP * min(motion.period, 1.0 / max(float(size.max()), 1e-300))
    given = _values(motion, name, n, motion.times, motion.y, rates)
    ahead = _values(motion, name, n, motion.times + step, motion.y + step * rates, rates)
    behind = _values(motion, name, n, motion.times - step, motion.y - step * rates, rates)
    if given is None or ahead is None or behind is None:
        return
    slopes = (ahead[:, 0] - behind[:, 0]) / (2.0 * step)
    rounding = 1e-14 * np.abs(given[:, 0]) / step
    allowed = WRONG * (np.abs(slopes) + np.abs(given[:, 1])) + 100.0 * rounding + 1e-9
    wrong = (np.abs(slopes - given[:, 1]) > allowed) & good
    for k in np.flatnonzero(wrong.sum(axis=1) >= 2):
        i = int(np.flatnonzero(wrong[k])[0])
        problems.append(
            f"{name}: the rate of number {k} is {given[k, 1, i]:g} where its value changes by "
            f"{slopes[k, i]:g} per second along the motion."
        )
