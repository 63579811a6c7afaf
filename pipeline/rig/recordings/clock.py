"""Give all channels of a file the same sample times, evenly spaced within each piece (part without a gap)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pipeline.rig.recordings.channels import Channel, Finding, runs
from pipeline.specification.problems import SpecError

GAP_STEPS = 1.5
"""Distance of two time stamps above which there is a gap [sampling intervals]."""


SHAKY = 0.05
"""Median deviation of time stamps from even steps above which a late stamp may be jitter, not a gap."""


REPEATING = 0.01
"""Fraction of equal neighbouring time stamps above which they are coarser than the sampling."""

EVEN = 0.01
"""Deviation of a time stamp from even steps that is not reported [sampling intervals]."""


@dataclass(eq=False)
class Clock:
    """Uniform sample times of a recording, and the range of samples used from each channel."""

    time: np.ndarray  # times, (n,) [s since the first sample], even within a piece
    piece: np.ndarray  # index of the piece, (n,): 0, 1, ...
    step_s: float  # sampling interval [s]
    taken: list[dict[str, tuple[int, int]]]  # for each stretch, by channel, the first sample and the one after the last
    findings: list[Finding] = field(default_factory=list)  # findings about times


def clock_of(
    stretches: Sequence[Mapping[str, Channel]],
    sampling_rate_hz: float | None,
    source: str,
    *,
    numbers: np.ndarray | None = None,
    apart: bool = False,
) -> Clock:
    """Give the channels of all stretches of a file the same uniform sample times.

    All channels begin at the latest start and end at the earliest end; samples left out are findings. A
    `sampling_rate_hz` from the mapping takes precedence over the file's. A new piece begins where the piece number of
    the first channel's samples, `numbers`, changes, and with `apart` at each stretch.

    Raise `SpecError` if no sampling interval is known, channels have different ones, time stamps go backwards, or there
    are no samples.
    """
    stated = None if sampling_rate_hz is None else 1.0 / sampling_rate_hz
    step = _common_step(stretches, stated, source)
    findings = _rate_findings(stretches, stated)
    taken, stamps = [], []
    for channels in stretches:
        where, found = _aligned(channels, step, source)
        first = next(iter(channels.values()))
        begin, end = where[first.name]
        taken.append(where)
        stamps.append(_stamps(first, stated)[begin:end] if len(first) else np.empty(0))
        findings += found
    stamps, cut = _one_after_another(_checked_stamps(stamps, step, source), step, findings)
    begins = np.cumsum([0, *(len(s) for s in stamps)])[:-1]
    forced = np.zeros(sum(map(len, stamps)), dtype=bool)
    forced[begins] = apart or cut
    if numbers is not None:
        forced |= _changes(numbers, stretches, taken)
    time, piece, own_step, found = _cut(np.concatenate(stamps) - stamps[0][0], forced, step, stated, source)
    return Clock(time, piece, own_step, taken, findings + found)


def resampled(channel: Channel, rate_hz: float) -> Channel:
    """Return a channel with time stamps at even steps: linear interpolation between neighbours, NaN in gaps.

    A gap is a step of more than `GAP_STEPS` times the longest of 99 % of the steps, and more than that many steps of
    the new rate.
    """
    time = channel.time
    if time is None or len(time) < 2 or not (np.diff(time) > 0.0).all():
        raise SpecError(f"resample: the time stamps of {channel.name} must be numbers that increase.")
    even = time[0] + np.arange(math.floor((time[-1] - time[0]) * rate_hz + 1e-9) + 1) / rate_hz
    values = np.interp(even, time, channel.values)
    steps = np.diff(time)
    gap = GAP_STEPS * max(float(np.quantile(steps, 0.99)), 1.0 / rate_hz)
    before = np.clip(np.searchsorted(time, even, side="right") - 1, 0, len(steps) - 1)
    inside = (steps[before] > gap) & (even > time[before]) & (even < time[before + 1])
    values[inside] = np.nan
    return replace(channel, time=even, values=values)


def _refuse_irregular(time: np.ndarray, is_gap: np.ndarray, step: float, source: str) -> None:
    """Raise `SpecError` if samples were taken at irregular times: every few samples would begin a piece."""
    often = 0.02  # fraction of samples with a gap before them above which the sampling is irregular
    steps = np.diff(time)
    off = np.abs(steps / step - np.round(steps / step))
    if is_gap.mean() > often and np.median(off) > SHAKY:
        low, high = 1e3 * np.quantile(steps, (0.01, 0.99))
        raise SpecError(
            f"{source}: samples are taken at irregular times, with steps of {low:.3g} to {high:.3g} ms: no rate fits, "
            f"and they would fall into {int(is_gap.sum()) + 1} pieces. Add to the mapping: resample = "
            f"{float(f'{len(steps) / (time[-1] - time[0]):.3g}'):g}, the rate [Hz] to which values are interpolated."
        )


def _changes(
    numbers: np.ndarray, stretches: Sequence[Mapping[str, Channel]], taken: Sequence[Mapping[str, tuple[int, int]]]
) -> np.ndarray:
    """Return a mask of the samples at which the piece number in the file changes."""
    parts, first = [], 0
    for channels, where in zip(stretches, taken, strict=True):
        name, channel = next(iter(channels.items()))
        begin, end = where[name]
        parts.append(numbers[first + begin : first + end])
        first += len(channel)
    own = np.concatenate(parts)
    return np.concatenate([[False], own[1:] != own[:-1]])


def _stamps(channel: Channel, stated: float | None) -> np.ndarray:
    if channel.time is not None and stated is None:
        return channel.time
    step = channel.step_s if stated is None else stated
    return np.asarray(channel.start_s + step * np.arange(len(channel)))


def step_of(channel: Channel) -> float:
    """Return the sampling interval of one channel [s], from its time stamps or as the file states it."""
    if channel.time is None or len(channel.time) < 2:
        return channel.step_s
    steps = np.diff(channel.time)
    usual = float(np.median(steps))
    if usual > 0.0 and np.mean(steps == 0.0) < REPEATING:
        return usual
    # stamps coarser than the sampling repeat: take the mean step without gaps
    mean = float(steps.mean())
    grain = float(steps[steps > 0.0].min(initial=np.inf))
    short = steps[steps <= GAP_STEPS * mean + grain]
    return float(short.mean()) if short.size else mean


def _common_step(stretches: Sequence[Mapping[str, Channel]], stated: float | None, source: str) -> float:
    steps = {name: step_of(c) for channels in stretches for name, c in channels.items()}
    if stated is not None and not any(c.time is not None for s in stretches for c in s.values()):
        rates = {n: s for n, s in steps.items() if math.isfinite(s)}
        _refuse_mixed(rates, source)
        return stated
    unknown = [name for name, s in steps.items() if not (math.isfinite(s) and s > 0.0)]
    if unknown:
        raise SpecError(
            f"{source}: the sampling interval of {', '.join(unknown)} is not known; add to the mapping "
            'time = { channel = "NAME" } if there are time stamps, or sampling_rate_hz = NUMBER.'
        )
    _refuse_mixed(steps, source)
    return stated if stated is not None else float(np.median(list(steps.values())))


def _refuse_mixed(steps: Mapping[str, float], source: str) -> None:
    mixed = 1e-3  # relative difference of sampling intervals above which channels have different rates
    if steps and max(steps.values()) > (1.0 + mixed) * min(steps.values()):
        told = ", ".join(f"{name} {1.0 / s:.6g} Hz" for name, s in steps.items())
        raise SpecError(
            f"{source}: the mapped channels have different sampling rates ({told}); map channels of one "
            "rate, or resample the file to one before it is read."
        )


def _rate_findings(stretches: Sequence[Mapping[str, Channel]], stated: float | None) -> list[Finding]:
    if stated is None:
        return []
    findings = []
    for name, channel in stretches[0].items():
        step = step_of(channel)
        if math.isfinite(step) and abs(step / stated - 1.0) > 1e-6:
            rates = f"the file says {1.0 / step:.8g} Hz, the mapping {1.0 / stated:.8g} Hz"
            text = f"{rates}; the mapping's is used."
            findings.append(Finding("rate", name, text=text))
        if channel.time is not None:
            text = "the file's time stamps are not used, nor gaps in them seen: the mapping states a rate."
            findings.append(Finding("rate", name, severity="note", text=text))
    return findings


def _aligned(
    channels: Mapping[str, Channel], step: float, source: str
) -> tuple[dict[str, tuple[int, int]], list[Finding]]:
    """Return the sample range in which all channels of a stretch have data, and findings on samples left out."""
    starts = {n: float(c.time[0]) if c.time is not None and len(c) else c.start_s for n, c in channels.items()}
    known = [s for s in starts.values() if math.isfinite(s)]
    first = max(known, default=0.0)
    late = {n: (first - s) / step if math.isfinite(s) else 0.0 for n, s in starts.items()}
    begins = {n: min(round(d), len(channels[n])) for n, d in late.items()}
    n_common = min(len(c) - begins[n] for n, c in channels.items())
    if n_common < 2:
        told = ", ".join(f"{n} has {len(c)} samples from {starts[n]:.6g} s" for n, c in channels.items())
        raise SpecError(f"{source}: the mapped channels have no stretch in common ({told}).")
    findings = _start_findings(late, step, len(known) == len(channels))
    findings += _length_findings({n: len(c) - begins[n] for n, c in channels.items()}, n_common, step)
    return {n: (b, b + n_common) for n, b in begins.items()}, findings


def _start_findings(late: Mapping[str, float], step: float, all_known: bool) -> list[Finding]:
    findings = []
    for name, distance in late.items():
        whole, rest = round(distance), distance - round(distance)
        if whole:
            findings.append(
                Finding(
                    "start",
                    name,
                    0.0,
                    0.0,
                    text=f"begins {whole * step:.6g} s before the last channel to begin; its first {whole} "
                    "samples are left out.",
                )
            )
        if abs(rest) > EVEN:
            findings.append(
                Finding(
                    "start",
                    name,
                    0.0,
                    0.0,
                    text=f"is sampled {abs(rest) * step:.3g} s {'after' if rest < 0.0 else 'before'} the others; "
                    "it is laid on their instants as it is.",
                )
            )
    if not all_known and any(late.values()):
        findings.append(
            Finding("start", "", 0.0, 0.0, text="some channels do not say when they begin; with the last is assumed.")
        )
    return findings


def _length_findings(lengths: Mapping[str, int], n_common: int, step: float) -> list[Finding]:
    short = [n for n, length in lengths.items() if length == n_common]
    return [
        Finding(
            "length",
            name,
            n_common * step,
            length * step,
            text=f"has {length} samples, {', '.join(short)} only {n_common}; "
            f"the last {length - n_common} are left out.",
        )
        for name, length in lengths.items()
        if length > n_common
    ]


def _checked_stamps(stamps: list[np.ndarray], step: float, source: str) -> list[np.ndarray]:
    if all(np.isnan(s).all() for s in stamps):
        return [step * np.arange(len(s)) for s in stamps]
    for s in stamps:
        bad = np.flatnonzero(~np.isfinite(s))
        if bad.size:
            raise SpecError(f"{source}: time stamp {bad[0]} is no number; give sampling_rate_hz instead of time.")
    _refuse_backwards(stamps, source)
    return stamps


def _cut(
    time: np.ndarray, forced: np.ndarray, step: float, stated: float | None, source: str
) -> tuple[np.ndarray, np.ndarray, float, list[Finding]]:
    """Divide samples into pieces at gaps and where `forced` is true, with even times within each piece."""
    is_gap = _missing(time, step) > 0
    if stated is None:
        _refuse_irregular(time, is_gap, step, source)
    piece = np.cumsum(is_gap | np.concatenate([[False], forced[1:]])).astype(np.int64)
    even, own_step, residual = _even(time, piece, step, stated)
    findings = [
        Finding(
            "gap",
            "",
            float(time[i - 1]),
            float(time[i]),
            text=f"{round((even[i] - even[i - 1]) / own_step) - 1} samples are missing; a new piece begins.",
        )
        for i in np.flatnonzero(is_gap)
    ]
    return even, piece, own_step, findings + _jitter_findings(even, residual, own_step)


def _missing(time: np.ndarray, step: float) -> np.ndarray:
    """Return the number of samples missing before each sample, from its time stamp.

    With jitter, a late stamp is no gap if the stamps after it are in time again, by their mean phase.
    """
    result = np.zeros(len(time), dtype=np.int64)
    distance = np.diff(time)
    if not distance.size:
        return result
    # stamps coarser than the sampling repeat, then jump by their own resolution
    repeats = bool(np.mean(distance == 0.0) >= REPEATING)
    grain = float(distance[distance > 0.0].min(initial=np.inf)) if repeats else 0.0
    late = np.flatnonzero(distance > GAP_STEPS * step + grain) + 1
    skipped = np.round(distance[late - 1] / step) - 1.0
    if float(np.median(np.abs(distance / step - 1.0))) > SHAKY:
        skipped = _skipped(time, step, late, skipped >= 2.0)
    result[late] = np.maximum(skipped, 0.0).astype(np.int64)
    return result


def _skipped(time: np.ndarray, step: float, late: np.ndarray, is_sure: np.ndarray) -> np.ndarray:
    """Return the number of samples lost before each late time stamp, from the shift of the stamps around it.

    Stamps beyond another gap are not used. Of neighbouring doubtful stamps the one with the largest shift
    counts.
    """
    around = 8  # number of time stamps on either side of a late one that distinguish jitter from a gap
    phase = np.concatenate([[0.0], np.cumsum(time / step - np.arange(len(time)))])
    walls = np.concatenate([[0], late[is_sure], [len(time)]])
    place = np.searchsorted(walls, late)
    before = np.maximum(late - around, walls[place - 1])
    after = np.minimum(late + around, walls[place + is_sure])
    shift = (phase[after] - phase[late]) / (after - late) - (phase[late] - phase[before]) / (late - before)
    skipped = np.round(shift)
    doubtful = np.flatnonzero(~is_sure & (skipped >= 1.0))
    for i in doubtful:
        beside = doubtful[np.abs(late[doubtful] - late[i]) < around]
        if shift[beside].max() > shift[i]:
            skipped[i] = 0.0
    return np.asarray(skipped)


def _refuse_backwards(stamps: list[np.ndarray], source: str) -> None:
    for s in stamps:
        falling = np.flatnonzero(np.diff(s) < 0.0)
        if falling.size:
            i = int(falling[0])
            raise SpecError(
                f"{source}: time goes backwards after sample {i} ({s[i]:.9g} s, then {s[i + 1]:.9g} s; "
                f"{falling.size} times in all); give sampling_rate_hz instead of time if the "
                "samples are even, or cut the file there."
            )


def _one_after_another(stamps: list[np.ndarray], step: float, findings: list[Finding]) -> tuple[list[np.ndarray], bool]:
    """Lay stretches whose time restarts after the one before; return the time stamps, and whether any was."""
    placed = [stamps[0]]
    moved = 0
    for s in stamps[1:]:
        last = placed[-1][-1]
        anew = s[0] <= last
        placed.append(s - s[0] + last + step if anew else s)
        moved += anew
    if moved:
        findings.append(
            Finding(
                "pieces",
                severity="note",
                text=f"the clock begins anew in {moved} of {len(stamps)} stretches; they are laid one after another, "
                "a sampling interval apart. How far apart they were is not known.",
            )
        )
    return placed, moved > 0


def _even(
    time: np.ndarray, piece: np.ndarray, step: float, stated: float | None
) -> tuple[np.ndarray, float, np.ndarray]:
    """Fit lines of equal slope to the time stamps by piece; return times on them, slope and residuals."""
    count = np.bincount(piece)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    index = np.arange(len(time)) - first[piece]
    index = index - ((count - 1) / 2.0)[piece]
    mean = np.bincount(piece, time) / count
    spread = float(index @ index)
    slope = float(index @ (time - mean[piece])) / spread if spread > 0.0 else step
    if stated is not None:
        slope = stated
    else:
        # a round rate, if the stamps do not contradict it
        rounded = 1.0 / float(f"{1.0 / slope:.5g}")
        if abs(rounded - slope) * count.max() < EVEN * slope:
            slope = rounded
    even = mean[piece] + slope * index
    return even - even[0], slope, time - even


def _jitter_findings(time: np.ndarray, residual: np.ndarray, step: float) -> list[Finding]:
    """Report time stamps that deviate from even steps, as a warning from half a step on."""
    uneven = 0.5  # deviation from even steps above which samples are misplaced [sampling intervals]
    worst, spread = float(np.abs(residual).max()), float(residual.std())
    if worst <= EVEN * step:
        return []
    text = (
        f"time stamps deviate from even steps of {step:.6g} s by {spread:.3g} s (standard deviation), "
        f"{worst:.3g} s at most"
    )
    if worst < uneven * step:
        return [
            Finding(
                "jitter", "", float(time[0]), float(time[-1]), severity="note", text=f"{text}; even steps are used."
            )
        ]
    far = runs(np.abs(residual) >= uneven * step)
    return [
        Finding(
            "jitter",
            "",
            float(time[far[0, 0]]),
            float(time[far[-1, 1] - 1]),
            text=f"{text}; even steps are used. If the sampling itself was uneven, add resample = "
            f"{1.0 / step:.4g} to the mapping.",
        )
    ]
