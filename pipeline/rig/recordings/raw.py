"""Define the data that all readers return: named channels as in the file, each with separate sample times."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.rig.recordings.findings import Finding


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
