"""Define the channels that all readers return, and findings: faults of a recording and corrections made to it."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import xarray as xr

# ---- findings --------------------------------------------------------------------------------------

Severity = Literal["note", "warning", "error"]
SEVERITIES: tuple[Severity, ...] = ("note", "warning", "error")


@dataclass(frozen=True)
class Finding:
    """Finding: a fault in a recording, or a correction made to it, with its time, severity and description."""

    kind: str  # one word, such as ``gap``; `KINDS` describes each
    channel: str = ""  # name in the dataset, or in the file before it is mapped; empty if it concerns all channels
    # place in the recording [s since its first sample]; NaN if it is unknown
    start_s: float = math.nan
    end_s: float = math.nan
    # ``note``: a correction as requested, nothing is lost. ``warning``: some samples cannot be used, or are less exact.
    # ``error``: results from this recording will be wrong unless it is corrected.
    severity: Severity = "warning"
    text: str = field(kw_only=True)  # a sentence with the remedy, if there is one


KINDS = {
    "truncated": "the file ends before the end that its own header states",
    "length": "channels of one file have different numbers of samples",
    "start": "channels of one file begin at different instants",
    "rate": "the sampling rate is not what the file or the mapping states",
    "jitter": "time stamps deviate from even steps",
    "gap": "samples are missing between two time stamps",
    "pieces": "the file's stretches have no common clock",
    "missing": "samples are no numbers",
    "constant": "a channel does not move at all",
    "saturated": "samples lie at the end of the sensor's range",
    "dead-band": "samples lie where the sensor does not measure",
    "wrap": "the angle jumps by a turn",
    "leap": "the angle leaps from one sample to the next as nothing moves",
    "unit": "the file states another unit than the mapping",
    "name": "the name in the file has a unit that the name in the mapping lacks",
}
"""All kinds of findings."""


def findings_of(ds: xr.Dataset) -> list[Finding]:
    """Return the findings stored in a recording's attribute ``findings``."""
    rows = json.loads(ds.attrs.get("findings", "[]"))
    return [
        Finding(**{**row, **{k: math.nan if row[k] is None else row[k] for k in ("start_s", "end_s")}}) for row in rows
    ]


def to_json(findings: Iterable[Finding]) -> str:
    """Return findings as a JSON list; unknown times are null."""
    rows = [{k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(f).items()} for f in findings]
    return json.dumps(rows)


def summary(findings: Iterable[Finding]) -> list[str]:
    """Return findings as printed lines, the most severe first; findings of the same kind and channel share one line."""
    groups: dict[tuple[str, str, str], list[Finding]] = {}
    for f in sorted(findings, key=lambda f: -SEVERITIES.index(f.severity)):
        groups.setdefault((f.severity, f.kind, f.channel), []).append(f)
    return [_group_line(*key, own) for key, own in groups.items()]


def _group_line(severity: str, kind: str, channel: str, own: Sequence[Finding]) -> str:
    first = own[0]
    where = "" if math.isnan(first.start_s) else f" at {first.start_s:.6g} s"
    often = f" ({len(own)} times, first{where})" if len(own) > 1 else where
    return f"{severity}: {kind}{f' of {channel}' if channel else ''}{often}: {first.text}"


def runs(mask: np.ndarray, piece: np.ndarray | None = None) -> np.ndarray:
    """Return the first index of each run of true entries in a mask, and the one after its last, (n_runs, 2).

    Runs end where a piece, given by its index for each sample, does.
    """
    inside = np.concatenate([[False], np.asarray(mask, dtype=bool), [False]])
    change = inside[1:] != inside[:-1]
    if piece is not None and len(piece) > 1:
        parted = (piece[1:] != piece[:-1]) & mask[1:] & mask[:-1]
        cuts = np.flatnonzero(parted) + 1
    else:
        cuts = np.empty(0, dtype=np.int64)
    places = np.flatnonzero(change)
    starts = np.sort(np.concatenate([places[::2], cuts]))
    ends = np.sort(np.concatenate([places[1::2], cuts]))
    return np.column_stack([starts, ends])


# ---- channels --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Channel:
    """Channel of a file: readings with unit and sample times, in one stretch."""

    name: str  # name as a mapping gives it
    values: np.ndarray  # readings as in the file, (n,) float64; NaN for fields that are not numbers
    unit: str = ""  # unit that the file states; empty if it does not
    # time of the first sample on a clock that the file's channels share [s]; NaN if it is not stated
    start_s: float = math.nan
    step_s: float = math.nan  # sampling interval that the file states [s]; NaN if it does not
    time: np.ndarray | None = None  # time stamps, (n,) [s], if the file has one for each sample

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True, eq=False)
class Raw:
    """Content of a recording's file before any mapping: its channels, in one or more stretches."""

    path: Path
    format: str
    sha256: str  # digest of its bytes
    # channels by name; several if the file separates recordings, such as the cells of MATLAB
    stretches: tuple[Mapping[str, Channel], ...]
    findings: tuple[Finding, ...] = ()  # faults of the file itself
    simulated: bool = False  # whether the file states that its readings are simulated
    apart: bool = False  # whether each stretch is a piece, even if it continues another

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all channels, in the file's order."""
        return tuple(dict.fromkeys(name for stretch in self.stretches for name in stretch))


def digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
