"""Build the least-squares problem of an identification from its TOML specification and its recordings."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from magpend_core.models.model import Model
from magpend_core.sampling import Drive
from pipeline.rig.edges import Edges, find_edges
from pipeline.rig.identify.measured_orbits import MeasuredTable, first_orbits
from pipeline.rig.identify.problem import DRIFT, PHASE, ZERO, Free, Piece, Problem, steady_drive
from pipeline.rig.identify.specification import IdentificationSpec, RecordingTable
from pipeline.rig.recordings import findings_of, load_mapping, read_recording, smooth, summary
from pipeline.specification.problems import SpecError

FEWEST_SAMPLES = 12
"""Fewest samples of a piece; a free start takes most of the information in a shorter one."""

DRIVE = "drive"
DUTY = "duty_cycle"


@dataclass(frozen=True)
class Built:
    """Least-squares problem of an identification, and held-out pieces on which the fit is only tested."""

    problem: Problem
    held_out: tuple[Piece, ...]  # pieces that are judged afterwards; only their starts are fitted
    tables: tuple[MeasuredTable, ...] = ()  # measured orbits, with those that only judge the fit
    simulated: bool = False  # whether any of the recordings is simulated
    findings: tuple[tuple[str, ...], ...] = ()  # sentences about each recording's findings, without notes


@dataclass(frozen=True)
class Stretch:
    """Range of samples of a recording that is fitted as one piece, with its own initial state."""

    recording: int
    number: int
    samples: slice
    continues: bool


def read_all(spec: IdentificationSpec) -> list[xr.Dataset]:
    """Read all recordings of a specification; raise `SpecError` with the problems of all."""
    found, problems = [], []
    for i, table in enumerate(spec.recordings):
        try:
            mapping = load_mapping(spec.path(table.mapping))
            found.append(read_recording(spec.path(table.file), mapping, window_s=table.window_s))
        except SpecError as error:
            problems += [f"recordings[{i}]: {p}" for p in error.problems]
    if problems:
        raise SpecError(problems)
    return found


def build(spec: IdentificationSpec, recordings: Sequence[xr.Dataset], tables: Sequence[MeasuredTable] = ()) -> Built:
    """Build the least-squares problem of a specification, its recordings and its measured orbits, and set held-out
    pieces apart.

    Raise `SpecError` with all problems at once, before anything is integrated: a missing channel or drive, pieces that
    are too short, held-out pieces that do not exist, nothing left to fit.
    """
    problems: list[str] = []
    channels = channels_of(spec.model, spec.fit.channels, recordings, problems) if recordings else ()
    problems += drive_problems(spec.model, spec.recordings, recordings, "recordings")
    if spec.fit.slopes == "variational" and any(t.drive == "known" and t.phase is None for t in spec.recordings):
        problems.append(
            'fit.slopes = "variational": gives no slopes by the phase of a known drive; use "differences", or give '
            "phase."
        )
    if problems:
        raise SpecError(problems)
    cuts = _cuts(spec, channels, recordings)
    smoothed = [smooth(ds) for ds in recordings]
    kept: list[Piece] = []
    held: list[Piece] = []
    for i, table in enumerate(spec.recordings):
        own = pieces_of(spec.model, channels, (recordings[i], smoothed[i]), table, i, spec.fit.decimate)
        held += [p for p in own if p.number in table.hold_out]
        kept += _rechained([p for p in own if p.number not in table.hold_out], len(kept))
    both = apply_settings([*kept, *held], {i: t.parameters for i, t in enumerate(spec.recordings)})
    kept, held = both[: len(kept)], both[len(kept) :]
    problem = Problem(
        model=spec.model,
        fixed=spec.values,
        free=free_of(spec, recordings),
        channels=channels,
        pieces=tuple(kept),
        tied=spec.tied,
        loss=spec.fit.loss,
        noise=noise_of(spec.model, channels, smoothed, spec.fit.noise),
        continuity=None if spec.fit.continuity == "free" else float(spec.fit.continuity),
        rtol=spec.fit.rtol,
        slopes=spec.fit.slopes,
        recorded=any(t.drive == "recorded" for t in spec.recordings),
    )
    problem = replace(problem, orbits=first_orbits(tables, problem.values(problem.start)))
    simulated = any(bool(ds.attrs.get("simulated")) for ds in recordings)
    said = tuple(
        (*summary(f for f in findings_of(ds) if f.severity != "note"), *cut.dropped_sentences())
        for ds, cut in zip(recordings, cuts, strict=True)
    )
    return Built(problem, tuple(replace(p, follows=-1) for p in held), tuple(tables), simulated, said)


def _cuts(spec: IdentificationSpec, channels: Sequence[str], recordings: Sequence[xr.Dataset]) -> list[_Cut]:
    """Cut all recordings; raise `SpecError` with the problems of all, before anything that takes time is done."""
    found, problems = [], list[str]()
    for i, (table, ds) in enumerate(zip(spec.recordings, recordings, strict=True)):
        try:
            cut = _cut(ds, table, channels, _drive_of(table, ds), i, spec.fit.decimate)
        except SpecError as error:
            problems += [f"recordings[{i}]: {p}" for p in error.problems]
            continue
        problems += _hold_out_problems(i, table, cut)
        found.append(cut)
    if problems:
        raise SpecError(problems)
    numbers = [(i, s.number) for i, cut in enumerate(found) for s, _ in cut.kept]
    if found and all(number in spec.recordings[i].hold_out for i, number in numbers):
        raise SpecError("recordings: all pieces are held out; leave some to be fitted.")
    return found


def channels_of(
    model: Model, wanted: Sequence[str], recordings: Sequence[xr.Dataset], problems: list[str]
) -> tuple[str, ...]:
    """Return the names of the measured states (channels) to compare with the model: those in the specification, or by
    default those that all recordings contain.

    By default a rate is left out if its state is measured, since it adds no information.
    """
    rates = {s.rate for s in model.states if s.rate}
    measured = [[n for n in model.state_names if n in ds.data_vars] for ds in recordings]
    if wanted:
        problems += [
            f"fit.channels: recordings[{i}] has no channel {name!r} (it has {', '.join(there) or 'none'}); "
            "map it, or leave it out."
            for i, there in enumerate(measured)
            for name in wanted
            if name not in there
        ]
        return tuple(wanted)
    common = [n for n in model.state_names if all(n in there for there in measured)]
    chosen = tuple(n for n in common if n not in rates) or tuple(common)
    if not chosen:
        problems.append(
            f"recordings: none measures a state of {model.name} ({', '.join(model.state_names)}) that all "
            "others do; map one."
        )
    return chosen


def drive_problems(
    model: Model, tables: Sequence[RecordingTable], recordings: Sequence[xr.Dataset], where: str
) -> list[str]:
    """Return problems with the drives of recordings: missing, of the wrong kind, or of mixed kinds."""
    problems = []
    for i, (table, ds) in enumerate(zip(tables, recordings, strict=True)):
        path = f"{where}[{i}].drive = {table.drive!r}"
        if table.drive == "known":
            problems += _clock_problems(model, table, ds, f"{where}[{i}]")
        elif table.drive != "none" and DRIVE not in ds:
            problems.append(f'{path}: the mapping names no drive channel; add [drive] there, or set drive = "none".')
        elif table.drive == "recorded" and ds[DRIVE].attrs.get("kind") == "signal":
            problems.append(
                f'{path}: the mapping calls the drive a signal, not a torque; use "edges", or map a torque '
                '(kind = "torque").'
            )
    kinds = {table.drive for table in tables}
    by_model = sorted(kinds & {"edges", "known"})
    if by_model and "recorded" in kinds:
        problems.append(
            f'{where}: drive = "{by_model[0]}" cannot stand beside "recorded" in one identification; take '
            "one of them for all driven recordings."
        )
    if by_model:
        problems += [
            f'{where}[{i}]: beside drive = "{by_model[0]}" of others, say what switches its drive off: parameters = '
            "{ NAME = 0.0 } with the name of the drive's amplitude."
            for i, table in enumerate(tables)
            if table.drive == "none" and not table.parameters
        ]
    if "edges" in kinds and DUTY not in model.parameter_names:
        problems.append(f'{where}: drive = "edges" asks for a model with a parameter {DUTY}; {model.name} has none.')
    return problems


def _clock_problems(model: Model, table: RecordingTable, ds: xr.Dataset, where: str) -> list[str]:
    """Return problems with a drive of known frequency."""
    if not model.clock.has_drive:
        return [f'{where}.drive = "known": {model.name} has no drive; use drive = "none".']
    assert table.frequency_hz is not None
    rate = 1.0 / float(np.median(np.diff(ds["time"].values)))
    if table.frequency_hz < 0.5 * rate:
        return []
    return [
        f"{where}.frequency_hz = {table.frequency_hz:g}: must be below {0.5 * rate:g} Hz, half of the recording's "
        "sampling rate; give it in Hz (not in rad/s), or correct the times of the mapping."
    ]


def _hold_out_problems(i: int, table: RecordingTable, cut: _Cut) -> list[str]:
    numbers, n = {s.number for s, _ in cut.kept}, len(cut.kept) + len(cut.dropped)
    if wrong := [k for k in table.hold_out if k >= n]:
        return [f"recordings[{i}].hold_out: there are pieces 0 to {n - 1}, and no {', '.join(map(str, wrong))}."]
    if short := [k for k in table.hold_out if k not in numbers]:
        few = f"has fewer than {FEWEST_SAMPLES} usable samples and is dropped"
        return [f"recordings[{i}].hold_out: piece {short[0]} {few}; give one of the others."]
    if table.drive == "known" and table.phase is None and numbers <= set(table.hold_out):
        return [
            f"recordings[{i}].phase: missing; all pieces are held out, so it cannot be fitted: give it (0 to 1 drive "
            "periods), or leave a piece to be fitted."
        ]
    return []


def free_of(spec: IdentificationSpec, recordings: Sequence[xr.Dataset]) -> tuple[Free, ...]:
    """Return the unknowns in the order of the specification: parameters, zero offsets of sensors with their drifts,
    phases of drives.
    """
    found, n_recordings = [], len(spec.recordings)
    for u in spec.unknowns:
        p = spec.model.parameter(u.name)
        mean, sd = (u.prior.mean, u.prior.sd) if u.prior is not None else (math.nan, math.nan)
        found.append(Free(u.name, u.start, u.lower, u.upper, p.unit, p.meaning, mean, sd))
    for name in spec.sensors.zero:
        state = spec.model.state(name)
        bound = math.pi / 2 if state.on_circle else math.inf
        for i in range(n_recordings):
            suffix = f".{i}" if n_recordings > 1 else ""
            meaning = f"zero offset of {name}" + (f" in recording {i}" if suffix else "")
            spread, seconds = float(np.nanstd(recordings[i][name].values)), float(np.ptp(recordings[i]["time"].values))
            found.append(Free(f"{ZERO}.{name}{suffix}", 0.0, -bound, bound, state.unit, meaning))
            if name in spec.sensors.drift:
                unit = "1/s" if state.unit == "1" else f"{state.unit}/s"
                rate = Free(f"{ZERO}.{name}{suffix}.{DRIFT}", 0.0, unit=unit, meaning=f"drift of the {meaning}")
                found.append(replace(rate, typical=spread / seconds))
    for i, table in enumerate(spec.recordings):
        if table.drive == "known" and table.phase is None:
            meaning = f"phase of the drive at time 0 of recording {i}, in drive periods"
            found.append(Free(f"{PHASE}.{i}", 0.0, unit="1", meaning=meaning, typical=1.0))
    return tuple(found)


def noise_of(
    model: Model, channels: Sequence[str], smoothed: Sequence[xr.Dataset], stated: Mapping[str, float]
) -> np.ndarray:
    """Return the noise of each channel [SI]: the standard deviation by which its residuals are divided.

    The specification may state it. Otherwise the recordings give it, one value for all channels of a unit: in
    most rigs the model's error exceeds the sensors' noise and is not proportional to it.
    """
    least = 1e-6  # noise of a channel as a fraction of its spread; simulated recordings may have no noise
    noise = {}
    for name in channels:
        own = [float(ds[name].attrs.get("noise", math.nan)) for ds in smoothed]
        spread = max(float(np.nanstd(ds[name].values)) for ds in smoothed)
        rms = math.sqrt(float(np.nanmean(np.square(own)))) if np.isfinite(own).any() else 0.0
        noise[name] = max(rms, least * spread) or least
    found = []
    for name in channels:
        unit = model.state(name).unit
        alike = [noise[other] ** 2 for other in channels if model.state(other).unit == unit]
        found.append(stated.get(name, math.sqrt(sum(alike) / len(alike))))
    return np.array(found)


def pieces_of(
    model: Model,
    channels: Sequence[str],
    both: tuple[xr.Dataset, xr.Dataset],
    table: RecordingTable,
    recording: int,
    decimate: int = 1,
) -> list[Piece]:
    """Cut a recording into the pieces that are fitted, each with samples, drive and a first guess of its initial state.

    `both` is the recording as measured, and smoothed for the guess. `decimate` is the step between the samples that are
    used. Pieces with fewer than `FEWEST_SAMPLES` usable samples are dropped; their numbers stay free. Raise `SpecError`
    if none is left or the drive does not cover them.
    """
    ds, smoothed = both
    drive = _drive_of(table, ds)
    found: list[Piece] = []
    for stretch, samples in _cut(ds, table, channels, drive, recording, decimate).kept:
        own = ds.isel(sample=samples)
        time = own["time"].values[::decimate]
        measured = np.stack([own[name].values[::decimate] for name in channels], axis=1)
        pieces_drive = None if drive is None else drive.window(float(time[0]), float(time[-1]))
        start = _start(model, smoothed.isel(sample=samples))
        whole = samples.start == stretch.samples.start
        follows = bool(found) and found[-1].number == stretch.number - 1 and stretch.continues and whole
        found.append(
            Piece(
                recording,
                stretch.number,
                time - time[0],
                measured,
                start,
                pieces_drive,
                len(found) - 1 if follows else -1,
                float(time[0]),
                table.frequency_hz or 0.0,
            )
        )
    return found


@dataclass(frozen=True)
class _Cut:
    """Stretches of a recording with their usable samples, and the number of samples of those that are too short."""

    kept: list[tuple[Stretch, slice]]
    dropped: dict[int, int]  # by the number of the stretch

    def dropped_sentences(self) -> list[str]:
        """Return a sentence about the stretches that are too short for a fit; none if there are none."""
        if not self.dropped:
            return []
        n = len(self.dropped)
        which = ", ".join(map(str, self.dropped)) if n <= 6 else f"{n} of {n + len(self.kept)}"
        return [
            f"pieces dropped: {which}, with fewer than {FEWEST_SAMPLES} usable samples ({sum(self.dropped.values())} "
            "in all)"
        ]


def _cut(
    ds: xr.Dataset, table: RecordingTable, channels: Sequence[str], drive: _Driven | None, recording: int, decimate: int
) -> _Cut:
    """Cut a recording into stretches, and drop remnants; raise `SpecError` if nothing else is there."""
    kept: list[tuple[Stretch, slice]] = []
    dropped: dict[int, int] = {}
    for stretch in stretches(ds, table.piece_s, recording):
        samples = _usable(ds, stretch, channels, drive)
        n = len(range(samples.start, samples.stop, decimate))
        if n < FEWEST_SAMPLES:
            dropped[stretch.number] = n
        else:
            kept.append((stretch, samples))
    if not kept:
        most = max(dropped.values(), default=0)
        raise SpecError(
            f"no piece has {FEWEST_SAMPLES} usable samples; the longest of {len(dropped)} has {most}: choose a longer "
            "piece_s or window_s, or a smaller fit.decimate. If gaps or uneven times part the samples, add resample = "
            "RATE [Hz] to the mapping."
        )
    return _Cut(kept, dropped)


def stretches(ds: xr.Dataset, piece_s: float | None, recording: int) -> list[Stretch]:
    """Cut each uninterrupted piece into equal stretches of about `piece_s` seconds; None keeps pieces whole."""
    found: list[Stretch] = []
    piece, time = ds["piece"].values, ds["time"].values
    for begin, end in _runs(piece):
        length = float(time[end - 1] - time[begin])
        n = 1 if piece_s is None else max(1, round(length / piece_s))
        bounds = np.linspace(begin, end, n + 1).round().astype(int)
        for k, (a, b) in enumerate(itertools.pairwise(bounds)):
            found.append(Stretch(recording, len(found), slice(int(a), int(b)), k > 0))
    return found


def _runs(piece: np.ndarray) -> list[tuple[int, int]]:
    cuts = np.flatnonzero(np.diff(piece)) + 1
    bounds = [0, *cuts.tolist(), len(piece)]
    return list(itertools.pairwise(bounds))


def _usable(ds: xr.Dataset, stretch: Stretch, channels: Sequence[str], drive: _Driven | None) -> slice:
    """Return a stretch's samples from the first with values of all channels to the last with a known drive."""
    begin, end = stretch.samples.start, stretch.samples.stop
    time = ds["time"].values[begin:end]
    good = np.all([np.isfinite(ds[name].values[begin:end]) for name in channels], axis=0)
    if drive is not None:
        good &= (time >= drive.begin_s) & (time <= drive.end_s)
        end = begin + int(np.searchsorted(time, drive.end_s, side="right"))
    first = np.flatnonzero(good)
    return slice(begin + int(first[0]), end) if first.size else slice(end, end)


def _start(model: Model, own: xr.Dataset) -> np.ndarray:
    """Return a first guess of the state at the first sample: smoothed measurements, and 0 for states not measured."""
    found = []
    for state in model.states:
        value = float(own[state.name].values[0]) if state.name in own else 0.0
        found.append(value if math.isfinite(value) else 0.0)
    return np.array(found)


@dataclass(frozen=True)
class _Driven:
    """Drive of a recording, with the times that it covers [s]; or its known frequency and phase at time 0."""

    drive: Drive | None
    begin_s: float
    end_s: float
    known: tuple[float, float] | None = None

    def window(self, begin: float, end: float) -> Drive:
        """Return the drive between two times of the recording [s]; zero torque if none was recorded."""
        if self.known is not None:
            frequency, phase = self.known
            return steady_drive(frequency, phase + frequency * begin, end - begin)
        if self.drive is None:
            # no torque here, while other recordings have one
            return Drive.from_torque(np.array([0.0, end - begin]), np.zeros(2))
        return self.drive.window(begin - self.begin_s, end - self.begin_s)


def _drive_of(table: RecordingTable, ds: xr.Dataset) -> _Driven | None:
    """Return the drive of a recording with the times that it covers, or None if the drive was off."""
    time = ds["time"].values
    if table.drive == "none":
        return None
    if table.frequency_hz is not None:
        # an unknown phase is fitted on top of 0
        return _Driven(None, float(time[0]), float(time[-1]), (table.frequency_hz, table.phase or 0.0))
    level = ds[DRIVE].values
    if table.drive == "recorded":
        known = np.isfinite(level)
        covered = time[known]
        if len(covered) < 2:
            raise SpecError("its drive channel has no values; map another channel.")
        return _Driven(Drive.from_torque(covered, level[known]), float(covered[0]), float(covered[-1]))
    edges = _steadied(find_edges(time, level))
    rising = edges.rising
    falling = np.array([edges.falling[edges.falling > r][:1] for r in rising[:-1]], dtype=object)
    if len(rising) < 2 or any(len(f) != 1 or f[0] >= r for f, r in zip(falling, rising[1:], strict=True)):
        raise SpecError(
            "its drive has no two rising edges with a falling one between each two; look at it with "
            "magpend recordings show, and choose a window in which it switches."
        )
    flat = np.array([float(f[0]) for f in falling])
    return _Driven(Drive.from_edges(rising, flat, name=DUTY), float(rising[0]), float(rising[-1]))


def _steadied(edges: Edges) -> Edges:
    """Replace the edges of a drive by evenly spaced ones if their scatter is only rounding to the sampling interval.

    A single edge is known to half a sampling interval; a line through many edges is known far better.
    """
    most = 0.45  # scatter of edges, in samples, that is taken for rounding; a uniform error has 0.29
    if not edges.resolution_s:
        return edges
    try:
        timing = edges.frequency()
    except SpecError:
        return edges
    if not timing.jitter_s < most * edges.resolution_s or not math.isfinite(timing.duty_cycle):
        return edges
    period = 1.0 / timing.frequency_hz
    number = np.round((edges.rising - edges.rising[0]) / period)
    first = float(np.mean(edges.rising - period * number))
    rising = np.asarray(first + period * np.arange(int(number[-1]) + 1), np.float64)
    falling = np.asarray(rising[:-1] + timing.duty_cycle * period, np.float64)
    return Edges(rising, falling, edges.resolution_s)


def _rechained(pieces: list[Piece], offset: int) -> list[Piece]:
    """Update `Piece.follows` after pieces were removed; it is -1 where the preceding piece was removed."""
    numbers = {p.number: offset + k for k, p in enumerate(pieces)}
    return [replace(p, follows=numbers.get(p.number - 1, -1) if p.follows >= 0 else -1) for p in pieces]


def apply_settings(pieces: Sequence[Piece], settings: Mapping[int, Mapping[str, float]]) -> list[Piece]:
    """Attach parameter values that hold for a single recording, given by its index, to the drives of that recording's
    pieces.

    The drives of all pieces then have values of the same parameters; NaN leaves a parameter unchanged.
    """
    names: dict[str, None] = {}
    for piece in pieces:
        names |= dict.fromkeys(piece.drive.names if piece.drive is not None else ())
        names |= dict.fromkeys(settings.get(piece.recording, {}))
    if not names:
        return list(pieces)
    return [_with(piece, tuple(names), settings.get(piece.recording, {})) for piece in pieces]


def _with(piece: Piece, names: tuple[str, ...], own: Mapping[str, float]) -> Piece:
    drive = piece.drive
    if drive is None:
        time = piece.time
        drive = Drive(np.array([2 * time[-1] - time[-2]]))
    values = np.full((len(drive.durations_s), len(names)), np.nan)
    for k, name in enumerate(names):
        if name in own:
            values[:, k] = own[name]
        elif name in drive.names:
            values[:, k] = drive.values[:, drive.names.index(name)]
    return replace(piece, drive=replace(drive, names=names, values=values))
