"""Choose the reader for a recording by the stated format or the file's suffix."""

from __future__ import annotations

from pathlib import Path

from pipeline.rig.recordings.mapping import CsvMap
from pipeline.rig.recordings.raw import Raw
from pipeline.specification.problems import SpecError

SUFFIXES = {
    ".tdms": "tdms",
    ".lvm": "lvm",
    ".csv": "csv",
    ".txt": "csv",
    ".tsv": "csv",
    ".dat": "csv",
    ".mat": "matlab",
}
"""Format by suffix."""


def format_of(path: Path, stated: str | None = None) -> str:
    """Return the format of a file: the stated one, otherwise that of its suffix.

    Raises
    ------
    SpecError
        If the suffix is unknown and nothing is stated.
    """
    if stated is not None:
        return stated
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise SpecError(
            f"{path}: the suffix {path.suffix!r} is none of {', '.join(SUFFIXES)}; "
            'add format = "tdms", "lvm", "csv" or "matlab" to the mapping.'
        )
    return SUFFIXES[suffix]


def read_raw(path: Path, stated: str | None = None, csv: CsvMap | None = None) -> Raw:
    """Read all channels of a recording's file with the reader for its format.

    Parameters
    ----------
    path
        The file.
    stated
        Format; by default given by the suffix.
    csv
        Form of a CSV file.

    Raises
    ------
    SpecError
        If the file does not exist, or does not have the format.
    """
    name = format_of(path, stated)
    if not path.is_file():
        raise SpecError(f"{path}: there is no such file.")
    if name == "matlab":
        from pipeline.rig.recordings.matlab import read_matlab

        raw = read_matlab(path)
    elif name == "tdms":
        from pipeline.rig.recordings.tdms import read_tdms

        raw = read_tdms(path)
    elif name == "lvm":
        from pipeline.rig.recordings.lvm import read_lvm

        raw = read_lvm(path)
    else:
        from pipeline.rig.recordings.delimited import read_csv

        raw = read_csv(path, csv or CsvMap())
    if not raw.names:
        raise SpecError(f"{path}: holds no channel of numbers.")
    return raw
