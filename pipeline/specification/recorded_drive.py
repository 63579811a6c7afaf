"""Read recorded drives: the table ``[drive]`` of a specification, and drive files with measured edges or a torque.

A drive file is CSV with one of two headers. Lines that begin with ``#`` are comments.

``rising_s,falling_s``
    Measured edges: one row per period, with the times of its rising and its falling edge. The last row holds
    the end of the last period and no falling edge. The model gives the drive's shape and amplitude.
``time_s,drive``
    The torque, or another forcing, in the model's unit. Values are interpolated linearly.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from pipeline.specification.files import has_digest, read_text
from pipeline.specification.problems import SpecError
from pipeline.specification.tables import FREQUENCY, Table

if TYPE_CHECKING:
    from magpend_core.models.model import Model
    from magpend_core.sampling import Drive

EDGES, TORQUE = "edges", "torque"
HEADERS = {EDGES: ("rising_s", "falling_s"), TORQUE: ("time_s", "drive")}
DUTY = "duty_cycle"
"""Parameter whose value measured edges set anew in each period."""

HOW = "; make one with: magpend recordings drive"
"""Remedy for a drive file that cannot be read."""
_COINCIDENT_S = 1e-9


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A recorded drive (edges or torque) with the times of its stroboscopic sections.

    Attributes
    ----------
    kind : str
        ``"edges"`` or ``"torque"``.
    file : str
        Name of its file, for messages.
    sha256 : str
        Digest of the file.
    first, second : ndarray
        Columns of the file: rising and falling edges [s], with one falling edge less; or times [s] and
        torque.
    sections_s : ndarray
        Times of the sections after the start [s, the file's clock].
    """

    kind: str
    file: str
    sha256: str
    first: np.ndarray
    second: np.ndarray
    sections_s: np.ndarray

    @property
    def start_s(self) -> float:
        """Time at which the drive and each trajectory begin [s, as in the file]."""
        return float(self.first[0])

    @property
    def end_s(self) -> float:
        """Time at which the drive ends [s, as in the file]."""
        return float(self.first[-1])

    @property
    def n_periods(self) -> int:
        """Number of stroboscopic sections during the drive."""
        return len(self.sections_s)

    @property
    def frequency_hz(self) -> float:
        """Mean frequency of the rising edges or sections [Hz]; one over the drive's length if there are fewer than
        two.
        """
        marks = self.first if self.kind == EDGES else self.sections_s
        if len(marks) < 2:
            return 1.0 / (self.end_s - self.start_s)
        return float((len(marks) - 1) / (marks[-1] - marks[0]))

    @cached_property
    def _times(self) -> np.ndarray:
        """Ends of the integration intervals of a recorded torque [s]: the times of its samples, and of stroboscopic
        sections between them.
        """
        between = np.searchsorted(self.first, self.sections_s)
        gap = np.minimum(
            np.abs(self.first[np.minimum(between, len(self.first) - 1)] - self.sections_s),
            np.abs(self.first[between - 1] - self.sections_s),
        )
        return np.union1d(self.first, self.sections_s[gap > _COINCIDENT_S])

    @cached_property
    def intervals(self) -> Drive:
        """Recorded drive as the `Drive` object that the integration engine uses; the first access imports numba."""
        from magpend_core.sampling import Drive

        if self.kind == EDGES:
            return Drive.from_edges(self.first, self.second, name=DUTY)
        return Drive.from_torque(self._times, np.interp(self._times, self.first, self.second))

    @property
    def n_intervals(self) -> int:
        """Number of time intervals in which the recorded drive is integrated."""
        return len(self.first if self.kind == EDGES else self._times) - 1

    @cached_property
    def section_ends(self) -> np.ndarray:
        """For each stroboscopic section, the index of the integration interval that ends at it."""
        if self.kind == EDGES:
            return np.arange(self.n_periods)
        return np.asarray(np.searchsorted(self._times, self.sections_s - _COINCIDENT_S) - 1)


def load_drive(path: str | Path, *, section_hz: float | None = None) -> RecordedDrive:
    """Read a drive file (CSV) and parse it into a `RecordedDrive`."""
    text, digest = read_text(path, HOW)
    return parse_drive(text, Path(path).name, digest, section_hz)


@lru_cache(maxsize=8)
def parse_drive(text: str, file: str, sha256: str, section_hz: float | None = None) -> RecordedDrive:
    """Parse the text of a drive file into a `RecordedDrive`.

    Parameters
    ----------
    text
        Text of the file; the docstring of this module describes it.
    file
        Name of the file, for messages.
    sha256
        Digest of the file.
    section_hz
        Sections per second of a torque, from its start on. By default sections lie at its `rising_edges`.

    Raises
    ------
    SpecError
        With all problems: a wrong header, fields that are not finite numbers, times that do not rise, edges
        out of order, too few edges.
    """
    kind, rows = _rows(text, file)
    first, second = _columns(kind, rows, file)
    problems = _edge_problems(first, second, file) if kind == EDGES else _torque_problems(first, second, file)
    if kind == EDGES and section_hz is not None:
        problems.append(
            f"drive.section_hz = {section_hz!r}: sections under measured edges lie at the rising ones; drop "
            "the key, or give a torque."
        )
    if problems:
        raise SpecError(problems)
    if kind == EDGES:
        return RecordedDrive(kind, file, sha256, first, second[: len(first) - 1], first[1:])
    if section_hz is None:
        return RecordedDrive(kind, file, sha256, first, second, rising_edges(first, second))
    n = math.floor((first[-1] - first[0]) * section_hz * (1 + 1e-12))
    sections = np.minimum(first[0] + np.arange(1, n + 1) / section_hz, first[-1])
    return RecordedDrive(kind, file, sha256, first, second, sections)


def rising_edges(time: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the times at which a sampled signal rises through the middle of its two levels [s].

    Parameters
    ----------
    time, level
        Samples, shape (n,), joined by straight lines; time rises.

    Returns
    -------
    ndarray
        Shape (n_edges,); empty for a constant signal. The levels are the 2nd and 98th percentiles over time.
        An edge counts if it crosses the middle half of the distance between them. If the signal crosses the
        middle several times on an edge, the mean of the first and the last crossing is returned.
    """
    crossed = 0.5  # fraction of the torque's range that an edge must cross to count
    even = np.interp(np.linspace(time[0], time[-1], max(20_000, 2 * len(time))), time, level)
    low, high = np.percentile(even, [2, 98])
    above, band = level - 0.5 * (low + high), 0.5 * crossed * (high - low)
    if not band > 0:
        return np.zeros(0)
    state = np.where(above > band, 1, np.where(above < -band, -1, 0))
    decided = np.flatnonzero(state)
    turns = np.flatnonzero(np.diff(state[decided]) > 0)
    found = []
    for a, b in zip(decided[turns], decided[turns + 1], strict=True):
        part = above[a : b + 1]
        at = a + np.flatnonzero((part[:-1] > 0) != (part[1:] > 0))[[0, -1]]
        share = above[at] / (above[at] - above[at + 1])
        found.append(float((time[at] + share * (time[at + 1] - time[at])).mean()))
    return np.array([t for t in found if t > time[0] + _COINCIDENT_S])


def _rows(text: str, file: str) -> tuple[str, list[tuple[int, list[str]]]]:
    lines = [(i, line.strip()) for i, line in enumerate(text.splitlines(), 1)]
    lines = [(i, line) for i, line in lines if line and not line.startswith("#")]
    header = tuple(word.strip().lstrip("\ufeff") for word in lines[0][1].split(",")) if lines else ()
    for kind, names in HEADERS.items():
        if header == names:
            return kind, [(i, [field.strip() for field in line.split(",")]) for i, line in lines[1:]]
    wanted = " or ".join(repr(",".join(names)) for names in HEADERS.values())
    raise SpecError(f"{file}: its columns are {','.join(header)[:80]!r}; a drive file begins with the line {wanted}.")


def _columns(kind: str, rows: list[tuple[int, list[str]]], file: str) -> tuple[np.ndarray, np.ndarray]:
    """Convert the rows of a drive file to two arrays of numbers; the last falling edge may be missing."""
    first, second = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
    problems = []
    for k, (line, fields) in enumerate(rows):
        if kind == EDGES and k == len(rows) - 1 and (len(fields) == 1 or fields[1:] == [""]):
            fields = [fields[0], "0"]
        try:
            first[k], second[k] = map(float, fields)
        except ValueError:
            problems.append(f"{file}, line {line}: {','.join(fields)[:60]!r} is not two numbers; correct it.")
            continue
        if not (math.isfinite(first[k]) and math.isfinite(second[k])):
            problems.append(
                f"{file}, line {line}: {','.join(fields)[:60]!r} is not finite; leave the line out, or record anew."
            )
    if problems:
        raise SpecError(_few(problems, file))
    return first, second


def _few(problems: list[str], file: str) -> list[str]:
    most = 5
    if len(problems) <= most:
        return problems
    return [*problems[:most], f"{file}: and {len(problems) - most} more lines like these."]


def _edge_problems(rising: np.ndarray, falling: np.ndarray, file: str) -> list[str]:
    if len(rising) < 2:
        return [f"{file}: has {len(rising)} rising edges; a period needs two: record longer."]
    problems = [
        f"{file}: rising_s = {rising[i + 1]:.9g} s follows {rising[i]:.9g} s; rising edges must rise: sort them."
        for i in np.flatnonzero(np.diff(rising) <= 0)
    ]
    between = (rising[:-1] < falling[:-1]) & (falling[:-1] < rising[1:])
    problems += [
        f"{file}: falling_s = {falling[i]:.9g} s must lie between its period's rising edges, "
        f"{rising[i]:.9g} s and {rising[i + 1]:.9g} s."
        for i in np.flatnonzero(~between & (np.diff(rising) > 0))
    ]
    return _few(problems, file)


def _torque_problems(time: np.ndarray, level: np.ndarray, file: str) -> list[str]:
    if len(time) < 2:
        return [f"{file}: has {len(time)} samples; a line needs two: record longer."]
    problems = [
        f"{file}: time_s = {time[i + 1]:.9g} s follows {time[i]:.9g} s; time must rise: sort or thin it."
        for i in np.flatnonzero(np.diff(time) <= 0)
    ]
    return _few(problems, file)


class DriveTable(Table):
    """The table ``[drive]``: a recording in place of the model's own drive."""

    file: str = Field(min_length=1, description="Drive file (CSV), relative to the specification.")
    section_hz: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="Sections per second of a torque; by default sections lie at its rising edges."
    )
    sha256: str | None = Field(default=None, description="Digest of the file; filled in when the file is read.")
    text: str | None = Field(default=None, description="The file's text; filled in when the file is read.")


def is_whole(table: Any) -> bool:
    """Return whether the recording in a ``[drive]`` table has the sha256 stored with it, or there is no such table."""
    if not isinstance(table, Mapping):
        return True
    return hashlib.sha256(str(table.get("text", "")).encode()).hexdigest() == table.get("sha256")


def recorded(table: DriveTable | None, problems: list[str]) -> RecordedDrive | None:
    """Parse the recording in a ``[drive]`` table; return None if there is no table or if it has problems."""
    if table is None or table.text is None:  # an unreadable file is reported already
        return None
    if not has_digest(table.text, table.sha256, table.file, "drive", problems) or table.sha256 is None:
        return None
    try:
        return parse_drive(table.text, Path(table.file).name, table.sha256, table.section_hz)
    except SpecError as error:
        problems += error.problems
        return None


def model_problems(drive: RecordedDrive, model: Model) -> list[str]:
    """Return the reasons why a model cannot be driven by a recording; empty if it can."""
    from magpend_core.engine.placeholders import no_forcing

    if model.system.forcing is no_forcing:
        return [f"drive: {model.name} has no drive that a recording could replace; drop the drive."]
    if drive.kind == EDGES and DUTY not in model.parameter_names:
        return [
            f"drive: measured edges need a model with a parameter {DUTY}, and {model.name} has none; give "
            "its drive as a torque (columns time_s,drive)."
        ]
    return []


def run_problems(
    drive: RecordedDrive | None, model: Model, data: Mapping[str, Any], integration: Any, starts: Any
) -> list[str]:
    """Return the problems of a specification with a recorded drive.

    Parameters
    ----------
    drive
        The recording; None if there is none, and then no problems.
    model
        Model that is integrated.
    data
        Tables of the specification; kind, axes, parameters and products are checked.
    integration, starts
        Valid tables of the specification, or None.
    """
    if drive is None:
        return []
    problems = model_problems(drive, model)
    if data.get("kind") == "continuation":
        problems.append(
            "drive: a continuation starts each value from the last state of the one before, and a recording "
            'cannot start again there; set kind = "sweep", or drop [drive].'
        )
    for table in ("axes", "parameters.overrides", "parameters"):
        problems += _replaced_problems(drive, table, data)
    if not drive.n_periods:
        problems.append(f"drive: {drive.file} has no rising edge after its start, so no section; set drive.section_hz.")
    elif integration is not None and integration.n_transient + integration.n_keep > drive.n_periods:
        problems.append(
            f"integration: n_transient = {integration.n_transient} and n_keep = {integration.n_keep} are "
            f"{integration.n_transient + integration.n_keep} drive periods, and {drive.file} has "
            f"{drive.n_periods}; lower them, or record longer."
        )
    if integration is not None and integration.stop_when_closed:
        problems.append(
            "integration.stop_when_closed: under a recorded drive only n_transient and n_keep set the "
            "length; drop the key."
        )
    if getattr(starts, "refine", None) is not None:
        problems.append(
            "initial_conditions.refine: cells are inferred from closed orbits, and the jitter of a "
            "recording keeps orbits from closing; drop the key, or [drive]."
        )
    problems += _idle_problems(drive, model, data.get("axes", {}))
    return problems + _product_problems(drive, data.get("products", {}))


def _idle_problems(drive: RecordedDrive, model: Model, axes: Mapping[str, Any]) -> list[str]:
    """Return problems of axes that sweep parameters of the model's own drive while a recorded torque replaces it."""
    if drive.kind != TORQUE or not set(axes) - {FREQUENCY, DUTY}:
        return []
    from magpend_core.engine.driven import drive_parameters

    idle = drive_parameters(model.system, model.load().pack())
    return [
        f"axes.{name}: changes only the model's own drive, which the torque of {drive.file} "
        "replaces; drop the axis, or give the drive as edges."
        for name in axes
        if name in idle and name != DUTY
    ]


def _replaced_problems(drive: RecordedDrive, table: str, data: Mapping[str, Any]) -> list[str]:
    """Return a problem for each drive frequency or duty cycle that is given although the recording determines it."""
    found: Any = data
    for key in table.split("."):
        found = found.get(key, {}) if isinstance(found, Mapping) else {}
    names = (DUTY,) if table.endswith("overrides") else (FREQUENCY,) if table == "parameters" else (FREQUENCY, DUTY)
    return [
        f"{table}.{name}: the recorded drive {drive.file} has its own; drop the key, or [drive]."
        for name in names
        if isinstance(found, Mapping) and name in found
    ]


def _product_problems(drive: RecordedDrive, products: Mapping[str, Any]) -> list[str]:
    problems = []
    if "lyapunov" in products:
        problems.append(
            "products.lyapunov: exponents are averages over many periods, and a recording "
            "ends; drop the product, or [drive]."
        )
    if "extremes" in products and drive.kind == TORQUE:
        problems.append(
            "products.extremes: extremes are taken over drive periods, and the intervals of a torque are not "
            "periods; drop the product, or give the drive as edges (columns rising_s,falling_s)."
        )
    return problems
