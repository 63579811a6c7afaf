"""Check the readings of one channel for faults, in the file's own units."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.rig.recordings.channels import Finding, runs
from pipeline.rig.recordings.mapping import ChannelMap

JUMP_TURNS = 0.6
"""Step between neighbouring samples of an angle above which it is a wrap [turns]."""


@dataclass(frozen=True, eq=False)
class Signal:
    """Readings of one channel, with the time of each sample and the number of its piece (part without a gap)."""

    name: str  # name in the dataset
    raw: np.ndarray  # readings, (n,) [the file's unit]
    time: np.ndarray  # times, (n,) [s]
    piece: np.ndarray  # index of the piece, (n,)

    def found(self, kind: str, start: int, end: int, severity: str, text: str) -> Finding:
        """Return a finding (fault report) about the samples from index `start` up to, not including, `end`."""
        first, last = float(self.time[start]), float(self.time[end - 1])
        return Finding(kind, self.name, first, last, severity=severity, text=text)  # type: ignore[arg-type]


def missing(signal: Signal) -> list[Finding]:
    """Report samples that are not numbers."""
    return [
        signal.found("missing", i, k, "warning", f"{k - i} samples are no numbers.")
        for i, k in runs(~np.isfinite(signal.raw), signal.piece)
    ]


def constant(signal: Signal, severity: str = "warning") -> list[Finding]:
    """Report a channel whose readings never change."""
    known = signal.raw[np.isfinite(signal.raw)]
    if known.size and np.ptp(known) > 0.0:
        return []
    level = f"is {known[0]:.6g} throughout" if known.size else "has no number"
    return [signal.found("constant", 0, len(signal.raw), severity, f"{level}; is the sensor connected, and mapped?")]


def saturated(signal: Signal, entry: ChannelMap) -> list[Finding]:
    """Report samples at the ends of the sensor's range. If the range is not stated, report peaks that look clipped.

    Samples in a dead band at the end of the range are not saturated; `in_dead_band` finds them.
    """
    if entry.range is None:
        return _cut_off(signal)
    low, high = entry.range
    at_end = (signal.raw <= low) | (signal.raw >= high)
    if entry.dead_band is not None:
        at_end &= ~_within(signal.raw, entry.dead_band)
    if entry.wraps:  # a wrapping reading passes both ends of the range
        at_end &= ~_beside_wraps(signal, 0.5 * (high - low))
    return [
        signal.found(
            "saturated",
            i,
            k,
            "warning",
            f"{k - i} samples at the end of the range from {low:g} to {high:g}: the true value lies beyond.",
        )
        for i, k in runs(at_end, signal.piece)
    ]


def _beside_wraps(signal: Signal, least: float) -> np.ndarray:
    jump = np.abs(np.diff(signal.raw)) > least
    beside = np.zeros(len(signal.raw), dtype=bool)
    beside[1:] |= jump
    beside[:-1] |= jump
    return beside


def _cut_off(signal: Signal) -> list[Finding]:
    """Find peaks that look clipped: equal extreme readings for longer than a turning point can last.

    Near a turning point with acceleration a, a reading of grain q stays constant for about 2*sqrt(2*q/a). The
    slope before it, times half that time, is a few grains. If it is many grains, the peak is clipped.
    """
    # equal readings at the extreme that may be a clipped peak, and the rise, in grains of the reading, that the slope
    # before it would have added at least
    fewest, rise = 5, 8.0
    raw, piece = signal.raw, signal.piece
    values = np.unique(raw[np.isfinite(raw)])
    if values.size < 3:  # a switching signal
        return []
    grain = max(float(np.median(np.diff(values))), 1e-12 * float(np.abs(values).max()))
    findings = []
    for level in (values[0], values[-1]):
        for i, k in runs(raw == level, piece):
            length = k - i
            lead = max(3, length // 2)
            if length < fewest or i < lead or piece[i - lead] != piece[i]:
                continue
            slope = abs(raw[i - 1] - raw[i - lead]) / (lead - 1)
            if slope * length / 2.0 > rise * grain:
                findings.append(
                    signal.found(
                        "saturated",
                        i,
                        k,
                        "warning",
                        f"{length} samples stay at {level:.6g}, the extreme: the top looks cut off. State the "
                        "sensor's range in the mapping.",
                    )
                )
    return findings


def _within(raw: np.ndarray, band: tuple[float, float]) -> np.ndarray:
    inside: np.ndarray = (raw >= band[0]) & (raw <= band[1])
    return inside


def in_dead_band(signal: Signal, entry: ChannelMap) -> tuple[np.ndarray, list[Finding]]:
    """Return a mask of the samples in the sensor's dead band, and findings that report them."""
    if entry.dead_band is None:
        return np.zeros(len(signal.raw), dtype=bool), []
    mask = _within(signal.raw, entry.dead_band)
    low, high = entry.dead_band
    return mask, [
        signal.found(
            "dead-band",
            i,
            k,
            "warning",
            f"{k - i} samples in the dead band from {low:g} to {high:g} are not measured; they are NaN.",
        )
        for i, k in runs(mask, signal.piece)
    ]


def unwrapped(signal: Signal, angle: np.ndarray, wraps: bool) -> tuple[np.ndarray, list[Finding]]:
    """Unwrap an angle [rad] within each piece if the mapping says that it wraps; otherwise report jumps by a full turn.

    The unwrapped angle is continuous from one measured sample of a piece to the next; NaN is not measured.
    """
    result = angle.copy()
    findings = []
    known = np.flatnonzero(np.isfinite(angle))
    turn = 2.0 * math.pi
    step = np.diff(angle[known])
    same = signal.piece[known[1:]] == signal.piece[known[:-1]]
    if wraps:
        turns = np.where(same, -np.round(step / turn), 0.0)
        # each piece begins with the angle as it was read
        total = np.concatenate([[0.0], np.cumsum(turns)])
        begins = np.concatenate([[0], np.flatnonzero(~same) + 1]) if known.size else np.empty(0, np.int64)
        base = np.repeat(total[begins], np.diff([*begins, len(known)])) if known.size else total[:0]
        result[known] += turn * (total[: known.size] - base)
        places = np.flatnonzero(turns)
        severity, text = "note", "wraps here; it is unwrapped, as asked for."
    else:
        places = np.flatnonzero(same & (np.abs(step) > JUMP_TURNS * turn))
        severity = "error"
        text = "jumps by a turn; if the reading wraps, add wraps = true to its mapping."
    for i in places:
        findings.append(signal.found("wrap", int(known[i]), int(known[i + 1]) + 1, severity, text))
    return result, findings


def leaps(signal: Signal, angle: np.ndarray) -> list[Finding]:
    """Find steps of an angle [rad] between samples that are too large for a motion and too small for a wrap by a full
    turn.

    An example is a wrap whose flank was sampled: it looks like a motion, and a turn is lost.
    """
    from scipy.ndimage import median_filter

    least = 0.1  # deviation of a step from the steps around it above which it is no motion [turns]
    around = 9  # number of steps whose median is the usual step

    step = np.diff(angle)
    step[signal.piece[1:] != signal.piece[:-1]] = np.nan
    known = np.isfinite(step)
    if not known.any():
        return []
    usual = median_filter(step[known], size=around, mode="nearest")
    off = np.zeros(len(step))
    off[known] = np.abs(step[known] - usual) / (2.0 * math.pi)
    is_leap = (off > least) & (off <= JUMP_TURNS)
    return [
        signal.found(
            "leap",
            i,
            k + 1,
            "error",
            f"leaps by {off[i:k].max():.2g} turns within a sample; if the sensor wraps here, state its dead "
            "band, so that what it reads there is left out.",
        )
        for i, k in runs(is_leap)
    ]
