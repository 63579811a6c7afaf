"""Make a drive file from a recording, readable by `pipeline.specification.recorded_drive`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from pipeline.rig.edges import DRIVE, Timing, edges_of
from pipeline.specification.problems import SpecError
from pipeline.specification.recorded_drive import EDGES, HEADERS, TORQUE, parse_drive

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DriveFile:
    """The text of a drive file, with a summary: timing, row and sample counts, interpolation error."""

    text: str
    timing: Timing | None  # frequency, jitter and duty cycle of its edges; None for a torque that is not periodic
    n_rows: int  # rows of the file's table
    n_samples: int  # samples of the recording
    error: float = 0.0  # largest distance of the torque's samples from the file's interpolated torque; 0 for edges
    notes: tuple[str, ...] = ()  # warnings about periods that may have lost an edge


def drive_file(recording: xr.Dataset, kind: str, *, tolerance: float = 0.0) -> DriveFile:
    """Make a drive file from a recording in one piece: switching times (``edges``), or values of the ``torque``.

    Samples of a torque are dropped if linear interpolation between the others meets them within `tolerance` [N m].

    Raise `SpecError` if there is no drive, if a torque is asked for and the drive is a signal, if the recording has a
    gap, or if it lacks two rising edges with one falling edge between each two.
    """
    problems = _problems(recording, kind, tolerance)
    if problems:
        raise SpecError(problems)
    made = _edges(recording) if kind == EDGES else _torque(recording, tolerance)
    parse_drive(made.text, str(recording.attrs.get("file", "the recording")), "")
    return made


def _problems(recording: xr.Dataset, kind: str, tolerance: float) -> list[str]:
    name = recording.attrs.get("file", "the recording")
    if DRIVE not in recording:
        return [f"{name}: its mapping names no drive channel; add [drive] there."]
    problems = []
    if kind == TORQUE and recording[DRIVE].attrs.get("kind") == "signal":
        problems.append(
            f"{name}: its mapping calls the drive a signal, not a torque; take --kind edges, or map a torque "
            '(kind = "torque").'
        )
    if not tolerance >= 0.0:
        problems.append(f"--tolerance {tolerance!r}: must be at least 0.")
    if kind == EDGES and tolerance:
        problems.append(f"--tolerance {tolerance!r}: edges are not thinned; drop it, or take --kind torque.")
    time, piece = recording["time"].values, recording["piece"].values
    cuts = np.flatnonzero(np.diff(piece))
    if cuts.size:
        first = int(cuts[0])
        problems.append(
            f"{name}: has {cuts.size + 1} pieces, and a drive has no gaps; choose a window inside of one, "
            f"such as --window {time[0]:.6g} {time[first]:.6g}."
        )
    return problems


def _head(recording: xr.Dataset, what: str, kind: str) -> list[str]:
    attrs = recording.attrs
    simulated = " (simulated)" if attrs.get("simulated") else ""
    source = f"{attrs.get('file', 'a recording')}{simulated}, sha256 {attrs.get('sha256', 'not known')}"
    return [f"# {what} of {source}", ",".join(HEADERS[kind])]


def _edges(recording: xr.Dataset) -> DriveFile:
    long = 1.5  # factor over the median period above which a period may have lost an edge
    edges = edges_of(recording)
    timing = edges.frequency()
    rising = edges.rising
    after = np.searchsorted(edges.falling, rising[:-1], side="right")
    between = np.searchsorted(edges.falling, rising[1:]) - after
    if (between != 1).any():
        wrong = int(np.flatnonzero(between != 1)[0])
        raise SpecError(
            f"drive: {int(between[wrong])} falling edges between the rising ones at {rising[wrong]:.6g} s "
            f"and {rising[wrong + 1]:.6g} s, and a period has one; choose a window without this, or look at "
            "it with: magpend recordings show."
        )
    falling = edges.falling[after]
    rows = [f"{a!r},{b!r}" for a, b in zip(rising[:-1].tolist(), falling.tolist(), strict=True)]
    lines = [*_head(recording, "Edges", EDGES), *rows, f"{float(rising[-1])!r},"]
    period = np.diff(rising)
    median = float(np.median(period))
    notes = tuple(
        f"the period from {rising[i]:.6g} s on is {period[i]:.4g} s, {period[i] / median:.2g} times the "
        "median; if an edge was missed there, choose a window without it"
        for i in np.flatnonzero(period > long * median)
    )
    text = "\n".join(lines) + "\n"
    return DriveFile(text, timing, len(rising), recording.sizes["sample"], notes=notes)


def _torque(recording: xr.Dataset, tolerance: float) -> DriveFile:
    known = np.isfinite(recording[DRIVE].values)
    if not known.any():
        raise SpecError("drive: its channel has no finite value; map another channel.")
    inside = slice(int(known.argmax()), len(known) - int(known[::-1].argmax()))
    time, level = recording["time"].values[inside], recording[DRIVE].values[inside]
    if not known[inside].all():
        gap = time[int((~known[inside]).argmax())]
        raise SpecError(f"drive: has no value at {gap:.6g} s; choose a window without gaps.")
    kept = thinned(time, level, tolerance)
    try:
        timing: Timing | None = edges_of(recording.isel(sample=inside)).frequency()
    except SpecError:  # a torque need not switch
        timing = None
    rows = [f"{t!r},{x!r}" for t, x in zip(time[kept].tolist(), level[kept].tolist(), strict=True)]
    text = "\n".join([*_head(recording, "Torque", TORQUE), *rows]) + "\n"
    error = float(np.abs(np.interp(time, time[kept], level[kept]) - level).max())
    return DriveFile(text, timing, len(rows), recording.sizes["sample"], error)


def thinned(time: Floats, level: Floats, tolerance: float) -> npt.NDArray[np.int64]:
    """Select samples (their indices, the first and the last included) between which linear interpolation meets all
    others.

    `tolerance` is the largest distance of a sample from the lines. Each line is extended as long as one slope meets all
    samples on the way.
    """
    kept, low, high = [0], -np.inf, np.inf
    for i in range(1, len(time)):
        start = kept[-1]
        if not low <= (level[i] - level[start]) / (time[i] - time[start]) <= high:
            start = i - 1
            kept.append(start)
            low, high = -np.inf, np.inf
        length = time[i] - time[start]
        low = max(low, (level[i] - tolerance - level[start]) / length)
        high = min(high, (level[i] + tolerance - level[start]) / length)
    return np.array([*kept, len(time) - 1])
