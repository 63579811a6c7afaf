"""From a recording to a drive file: what the motor did, as `pipeline.spec.drives` reads it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from pipeline.rig.edges import DRIVE, Timing, edges_of
from pipeline.spec.drives import EDGES, HEADERS, TORQUE, parse_drive
from pipeline.spec.problems import SpecError

Floats = npt.NDArray[np.float64]

LONG = 1.5
"""A period that is longer than the median by this factor has perhaps lost an edge."""


@dataclass(frozen=True)
class DriveFile:
    """A drive file before it is written, and what is in it.

    Attributes
    ----------
    text : str
        Its content.
    timing : Timing or None
        Frequency, jitter and duty cycle by its edges; None for a torque that is not periodic.
    n_rows : int
        Of its table.
    n_samples : int
        Of the recording.
    error : float
        Largest difference between the torque's samples and the lines of the file; 0 for edges.
    notes : tuple of str
        What looks as if an edge had been missed.
    """

    text: str
    timing: Timing | None
    n_rows: int
    n_samples: int
    error: float = 0.0
    notes: tuple[str, ...] = ()


def drive_file(recording: xr.Dataset, kind: str, *, tolerance: float = 0.0) -> DriveFile:
    """Make a drive file of a recording.

    Parameters
    ----------
    recording
        As `pipeline.rig.recordings.read_recording` gives it, with a drive, in one piece.
    kind
        ``"edges"``: the instants at which the drive switches; ``"torque"``: its values.
    tolerance
        Samples of a torque are left out that lie within this of the lines between those that stay [N m].

    Raises
    ------
    SpecError
        If there is no drive, it is a signal and a torque is asked for, the recording has a gap, or it has not
        what a drive file needs: two rising edges with one falling edge between each two.
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
    """Remarks on where a drive comes from, and the header."""
    attrs = recording.attrs
    simulated = " (simulated)" if attrs.get("simulated") else ""
    source = f"{attrs.get('file', 'a recording')}{simulated}, sha256 {attrs.get('sha256', 'not known')}"
    return [f"# {what} of {source}", ",".join(HEADERS[kind])]


def _edges(recording: xr.Dataset) -> DriveFile:
    edges = edges_of(recording)
    timing = edges.frequency()
    rising = edges.rising
    after = np.searchsorted(edges.falling, rising[:-1], side="right")
    between = np.searchsorted(edges.falling, rising[1:]) - after
    if (between != 1).any():
        wrong = int(np.flatnonzero(between != 1)[0])
        raise SpecError([
            f"drive: {int(between[wrong])} falling edges between the rising ones at {rising[wrong]:.6g} s "
            f"and {rising[wrong + 1]:.6g} s, and a period has one; choose a window without this, or look at "
            "it with: magpend recordings show."
        ])  # fmt: skip
    falling = edges.falling[after]
    rows = [f"{a!r},{b!r}" for a, b in zip(rising[:-1].tolist(), falling.tolist(), strict=True)]
    lines = [*_head(recording, "Edges", EDGES), *rows, f"{float(rising[-1])!r},"]
    period = np.diff(rising)
    median = float(np.median(period))
    notes = tuple(
        f"the period from {rising[i]:.6g} s on is {period[i]:.4g} s, {period[i] / median:.2g} times the "
        "median; if an edge was missed there, choose a window without it"
        for i in np.flatnonzero(period > LONG * median)
    )
    text = "\n".join(lines) + "\n"
    return DriveFile(text, timing, len(rising), recording.sizes["sample"], notes=notes)


def _torque(recording: xr.Dataset, tolerance: float) -> DriveFile:
    known = np.isfinite(recording[DRIVE].values)
    if not known.any():
        raise SpecError(["drive: its channel has no finite value; map another channel."])
    inside = slice(int(known.argmax()), len(known) - int(known[::-1].argmax()))
    time, level = recording["time"].values[inside], recording[DRIVE].values[inside]
    if not known[inside].all():
        gap = time[int((~known[inside]).argmax())]
        raise SpecError([f"drive: has no value at {gap:.6g} s; choose a window without gaps."])
    kept = thinned(time, level, tolerance)
    try:
        timing: Timing | None = edges_of(recording.isel(sample=inside)).frequency()
    except SpecError:  # it need not switch
        timing = None
    rows = [f"{t!r},{x!r}" for t, x in zip(time[kept].tolist(), level[kept].tolist(), strict=True)]
    text = "\n".join([*_head(recording, "Torque", TORQUE), *rows]) + "\n"
    error = float(np.abs(np.interp(time, time[kept], level[kept]) - level).max())
    return DriveFile(text, timing, len(rows), recording.sizes["sample"], error)


def thinned(time: Floats, level: Floats, tolerance: float) -> npt.NDArray[np.int64]:
    """Choose samples such that the lines between them pass all others within a tolerance.

    Parameters
    ----------
    time, level
        Samples, shape (n,); time rises.
    tolerance
        Largest distance of a sample from the lines, in the level's unit.

    Returns
    -------
    ndarray
        Numbers of the samples that stay, the first and the last among them. From each, the line goes on as
        long as one slope serves all that it passes.
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
