"""Cut a stepped sweep into stretches of constant frequency, or a slow continuous sweep into windows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from pipeline.rig.edges import Edges, Timing
from pipeline.rig.measured.declaration import TRANSIENT
from pipeline.specification.problems import SpecError

Floats = npt.NDArray[np.float64]

SWEEP_WINDOW, LEAST_STRETCH = 40, 8
"""Default numbers of periods: in a window of a slow sweep; at least in a stretch."""
_TRUE_JITTER = 1.5
"""Ratio of an edge's scatter to the error of measuring above which the drive itself jitters."""


@dataclass(frozen=True)
class Stretch:
    """Consecutive drive periods of one frequency: the edges at which section points are taken, and their timing."""

    # edges at which sections are taken, without the transient. If they scatter only by the error of measuring, rising
    # edges are placed on the line through all edges of the stretch, which is more exact.
    edges: Edges
    timing: Timing  # timing of all edges of the stretch
    # first and last edge [s], with the transient
    start_s: float
    end_s: float
    # standard errors of a rising edge [s]: the part that differs from edge to edge, and the part that all edges share.
    # The latter is up to half a sample if edges fall on the same place between two samples.
    instant_scatter_s: float
    instant_error_s: float
    direction: int  # 1 if the frequency rose to this stretch, -1 if it fell, 0 if there is no other

    @property
    def shake_s(self) -> float:
        """Jitter of the drive itself [s]; 0 if measurement error explains the scatter of the edges."""
        own = self.timing.jitter_s**2 - self.edges.error_s**2
        return math.sqrt(own) if self.timing.jitter_s > _TRUE_JITTER * self.edges.error_s else 0.0


def cut(edges: Edges, *, transient: int = TRANSIENT, window: int | None = None) -> list[Stretch]:
    """Cut a stepped sweep into stretches of constant frequency, or a slow continuous sweep into windows, in the order
    of time.

    The `transient` is dropped at the beginning of each constant stretch; a stretch keeps at least 8 periods. A `window`
    of 0 never cuts into windows. By default windows of 40 periods are used if stretches have only a few periods, or if
    most of them are curved the same way. Raise `SpecError` if a number is out of bounds, or nothing long enough is
    left.
    """
    problems = []
    if transient < 0:
        problems.append(f"transient = {transient}: must be at least 0.")
    if window is not None and window != 0 and window < LEAST_STRETCH:
        problems.append(f"window = {window}: must be 0 or at least {LEAST_STRETCH} periods.")
    if problems:
        raise SpecError(problems)
    if edges.rising.size <= LEAST_STRETCH:
        raise SpecError(
            f"drive: {edges.rising.size} rising edges; a stretch needs more than {LEAST_STRETCH}: choose a longer "
            "recording, or look at the drive's channel."
        )
    if window:
        return _directed(_windows(edges, window))
    spans = constant_spans(edges)
    kept = [(a, b) for a, b in spans if b - a >= transient + LEAST_STRETCH]
    if window is None and edges.rising.size > SWEEP_WINDOW and _is_swept(edges, spans):
        return _directed(_windows(edges, SWEEP_WINDOW))
    if not kept:
        longest = max(b - a for a, b in spans)
        raise SpecError(
            f"drive: the longest stretch of one frequency has {longest} periods, and {transient} of "
            f"transient and {LEAST_STRETCH} of sections are wanted: lower transient, or give window for a drive that "
            "is swept slowly."
        )
    return _directed([_constant(edges, a, b, transient) for a, b in kept])


def _is_swept(edges: Edges, spans: list[tuple[int, int]]) -> bool:
    """Return whether the frequency changes continuously: most stretches are short, or bend in one direction."""
    limit = 4.0  # curvature of a stretch, in standard errors, above which it is significant
    if len(spans) > 3 and np.median([b - a for a, b in spans]) < LEAST_STRETCH:
        return True
    bends = np.array([_bend(edges.rising[a : b + 1], _noise(edges)) for a, b in spans if b - a >= LEAST_STRETCH])
    clear = np.sign(bends[np.abs(bends) > limit])
    return bool(clear.size >= 3 and clear.size > 0.5 * bends.size and abs(clear.sum()) > 0.9 * clear.size)


def _bend(rising: Floats, noise: float) -> float:
    """Return the curvature of edge times over their number, in units of its standard error."""
    n = np.arange(rising.size) - 0.5 * (rising.size - 1)
    square = n**2 - (n**2).mean()
    return float(square @ rising / (noise * math.sqrt(square @ square)))


def constant_spans(edges: Edges) -> list[tuple[int, int]]:
    """Return first and last rising edge of each stretch of constant frequency; neighbours share an edge."""
    t = edges.rising
    noise = _noise(edges)
    spans, first = [], 0
    while first < t.size - 1:
        last = _reach(t, first, noise)
        if last < t.size - 1 and t[last + 1] - t[last] < 1.5 * (t[last] - t[first]) / (last - first):
            last = _placed(t, first, last)
        spans.append((first, last))
        lost = last + 1 < t.size and t[last + 1] - t[last] > 1.5 * (t[last] - t[first]) / max(last - first, 1)
        first = last + 1 if lost else last
    return spans


def _noise(edges: Edges) -> float:
    """Estimate the standard deviation of an edge time [s] from second differences, which steps hardly affect."""
    second = np.diff(edges.rising, 2)
    own = 1.4826 * float(np.median(np.abs(second))) / math.sqrt(6) if second.size else 0.0
    period = float(np.median(np.diff(edges.rising)))
    return max(own, edges.error_s, 1e-7 * period)


def _reach(t: Floats, first: int, noise: float) -> int:
    """Return the index of the last edge before the frequency changes; up to there, edge times lie on a line."""
    # deviation from the line through earlier edges, in standard deviations, that marks a step. Two successive edges
    # must deviate.
    limit = 5.0
    if first + 2 >= t.size:
        return int(t.size - 1)
    period = t[first + 1] - t[first]
    n = np.arange(t.size - first, dtype=np.float64)
    x = t[first:] - t[first] - period * n  # small numbers: nothing cancels in the sums below
    s0, s1, s2, sx, snx = 2.0, 1.0, 1.0, x[0] + x[1], x[1]
    off = 0
    for k in range(2, x.size):
        spread = s2 - s1 * s1 / s0
        slope = (snx - s1 * sx / s0) / spread
        ahead = n[k] - s1 / s0
        error = noise * math.sqrt(1 + 1 / s0 + ahead**2 / spread)
        miss = abs(x[k] - sx / s0 - slope * ahead)
        if t[first + k] - t[first + k - 1] > 1.5 * (period + slope):
            return first + k - 1
        off = off + 1 if miss > limit * error else 0
        if off == 2:
            return first + k - 2
        if not off:
            s0, s1, s2 = s0 + 1, s1 + n[k], s2 + n[k] ** 2
            sx, snx = sx + x[k], snx + n[k] * x[k]
    return int(t.size - 1)


def _placed(t: Floats, first: int, last: int) -> int:
    """Return the index of the edge at which the frequency steps, by the best fit of two lines to the edge times."""
    around = 16  # number of edges on either side of a step that determine its place
    low, high = max(first, last - around), min(t.size - 1, last + around)
    choices = range(max(low + 2, first + 1), min(last + 2, high - 1))
    costs = {k: _misfit(t[low : k + 1]) + _misfit(t[k : high + 1]) for k in choices}
    return min(costs, key=costs.__getitem__) if costs else last


def _misfit(t: Floats) -> float:
    n = np.arange(t.size) - 0.5 * (t.size - 1)
    x = t - t.mean()
    return float(((x - n * (n @ x) / (n @ n)) ** 2).sum())


def _constant(edges: Edges, first: int, last: int, transient: int) -> Stretch:
    """Return the stretch of constant frequency between two edges, without its transient."""
    rising = edges.rising[first : last + 1]
    own = edges.between(rising[0], math.nextafter(rising[-1], math.inf))
    return _stretch(own, np.zeros(rising.size), transient)


def _windows(edges: Edges, window: int) -> list[Stretch]:
    """Cut a slow sweep into windows of consecutive drive periods; the frequency of a window is that at its middle."""
    found = []
    for first in range(0, edges.rising.size - window, window):
        rising = edges.rising[first : first + window + 1]
        if np.diff(rising).max() > 1.5 * np.median(np.diff(rising)):
            continue  # a gap
        own = edges.between(rising[0], math.nextafter(rising[-1], math.inf))
        n = np.arange(window + 1, dtype=np.float64) - 0.5 * window
        bend = np.polynomial.Polynomial.fit(n, rising, 2).convert().coef
        curve = np.asarray((float(bend[2]) if bend.size > 2 else 0.0) * n**2)
        found.append(_stretch(own, curve, 0))
    if not found:
        raise SpecError(
            f"window = {window}: the recording has {edges.rising.size - 1} periods without a gap at most; "
            "choose a shorter window."
        )
    return found


def _stretch(own: Edges, curve: Floats, transient: int) -> Stretch:
    """Return a stretch with its timing; the known bend `curve` [s] is subtracted before a line is fitted."""
    rising = own.rising
    # a falling edge is shifted by interpolation between its rising ones
    falling = own.falling - np.interp(own.falling, rising, curve)
    timing = replace(own, rising=rising - curve, falling=falling).frequency()
    line = _line(rising - curve) + curve
    by_sampling = timing.jitter_s <= _TRUE_JITTER * own.error_s
    instants = line if by_sampling else rising
    scatter = timing.jitter_s * math.sqrt(2 / rising.size) if by_sampling else own.error_s
    common = own.common_error(line - curve, timing.jitter_s)
    falling = own.falling[own.falling > instants[transient]]
    kept = replace(own, rising=instants[transient:], falling=falling)
    return Stretch(kept, timing, float(rising[0]), float(rising[-1]), scatter, common, 0)


def _line(rising: Floats) -> Floats:
    """Return edge times on a line fitted over the edge number, in which missing edges count."""
    gaps = np.diff(rising)
    n = np.concatenate([[0.0], np.cumsum(np.maximum(np.rint(gaps / np.median(gaps)), 1.0))])
    centred = n - n.mean()
    slope = centred @ (rising - rising.mean()) / (centred @ centred)
    return np.asarray(rising.mean() + slope * centred)


def _directed(stretches: list[Stretch]) -> list[Stretch]:
    """Set the sweep direction of each stretch from the stretch before; the first takes that of the next."""
    f = np.array([s.timing.frequency_hz for s in stretches])
    error = np.array([s.timing.frequency_error_hz for s in stretches])
    signs = [0] * len(stretches)
    for i in range(1, len(stretches)):
        change, slack = f[i] - f[i - 1], 4 * math.hypot(error[i], error[i - 1])
        signs[i] = int(np.sign(change)) if abs(change) > slack else signs[i - 1]
    known = next((s for s in signs if s), 0)
    signs = [s or known for s in signs]
    return [replace(s, direction=sign) for s, sign in zip(stretches, signs, strict=True)]
