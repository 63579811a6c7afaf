"""What the readers of all formats give: named channels, each with its own clock, before any mapping."""

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
    """One channel of one stretch of a file.

    Attributes
    ----------
    name : str
        As a mapping names it.
    values : ndarray
        (n,) float64, as in the file; what is no number there is NaN.
    unit : str
        As the file states it; empty if it does not.
    start_s : float
        Instant of the first sample on a clock that the file's channels share [s]; NaN if it is not stated.
    step_s : float
        Sampling interval that the file states [s]; NaN if it does not.
    time : ndarray, optional
        (n,) time stamps [s] where the file has one for each sample.
    """

    name: str
    values: np.ndarray
    unit: str = ""
    start_s: float = math.nan
    step_s: float = math.nan
    time: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.values)


@dataclass(frozen=True, eq=False)
class Raw:
    """A file as it was read.

    Attributes
    ----------
    path : Path
    format : str
        Name of its format.
    sha256 : str
        Of its bytes.
    stretches : tuple of mappings
        Channels by name; more than one where the file keeps recordings apart, such as the cells of MATLAB.
    findings : tuple of Finding
        What was wrong with the file itself.
    simulated : bool
        Whether the file says that nobody measured it.
    apart : bool
        Whether the stretches are pieces even if one follows on another.
    """

    path: Path
    format: str
    sha256: str
    stretches: tuple[Mapping[str, Channel], ...]
    findings: tuple[Finding, ...] = ()
    simulated: bool = False
    apart: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all channels, in the file's order."""
        return tuple(dict.fromkeys(name for stretch in self.stretches for name in stretch))


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
