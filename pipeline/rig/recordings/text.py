"""Read numbers from text files: encodings, decimal commas, empty fields, dates."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.specification.problems import SpecError

_INSTANT = re.compile(
    r"(?:(?P<date>\d{4}-\d\d-\d\d)[T ])?(?P<time>\d\d:\d\d:\d\d(?:\.\d{1,9})?)(?P<zone>Z|[+-]\d\d:?\d\d)?"
)


def read_text(path: Path) -> str:
    """Return the text of a file, decoded as UTF-8 or else as cp1252, which LabVIEW on Windows writes.

    Raises
    ------
    SpecError
        If the file is not a text.
    """
    data = path.read_bytes()
    if b"\x00" in data[:4096]:
        raise SpecError(f"{path}: is not a text; state its format in the mapping if the suffix misleads.")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def number(field: str, decimal: str) -> float | None:
    """Return the number in a text field. Return NaN for an empty field and None for any other text."""
    text = field.strip().strip('"').strip()
    if not text:
        return float("nan")
    if decimal == ",":
        if "." in text:
            return None
        text = text.replace(",", ".")
    if "_" in text:  # only Python takes it for a number
        return None
    try:
        return float(text)
    except ValueError:
        return None


def split(line: str, delimiter: str) -> list[str]:
    """Split a line into its fields; a blank as delimiter also matches several blanks."""
    if delimiter == " ":
        return line.split()
    if '"' in line:
        import csv

        return next(csv.reader([line], delimiter=delimiter))
    return line.split(delimiter)


def table(lines: Sequence[str], columns: Sequence[int], delimiter: str, decimal: str) -> np.ndarray:
    """Convert chosen columns of text lines to an array of numbers; fields that are empty, missing or not numbers become
    NaN.

    Parameters
    ----------
    lines
        Lines without line ends.
    columns
        Indices of the wanted fields, from 0.

    Returns
    -------
    ndarray
        Numbers, (n_lines, n_columns).
    """
    if not lines or not columns:
        return np.empty((len(lines), len(columns)))
    text = "\n".join(lines)
    if decimal == ",":
        text = text.replace(",", ".")
    try:
        found = np.loadtxt(
            io.StringIO(text),
            delimiter=None if delimiter == " " else delimiter,
            usecols=columns,
            ndmin=2,
            comments=None,
            quotechar='"',
        )
        if found.shape == (len(lines), len(columns)):
            return found
    except (ValueError, IndexError):
        pass  # empty or short rows: slower, field by field
    rows = np.full((len(lines), len(columns)), np.nan)
    for i, line in enumerate(lines):
        parts = split(line, delimiter)
        for k, j in enumerate(columns):
            value = number(parts[j], decimal) if j < len(parts) else None
            rows[i, k] = np.nan if value is None else value
    return rows


def instants(fields: Sequence[str]) -> np.ndarray | None:
    """Convert dates or times of day to seconds since the first; return None if a field is anything else.

    Parameters
    ----------
    fields
        Texts in the order of ISO 8601, with a blank or a T between date and time, and a point or a comma
        before the fraction of a second.
    """
    found = [_INSTANT.fullmatch(f.strip().strip('"').replace("/", "-").replace(",", ".")) for f in fields]
    known = [m for m in found if m is not None]
    if len(known) < len(found) or not known or len({m["zone"] for m in known}) > 1:
        return None
    try:
        stamps = np.array([f"{m['date'] or '1970-01-01'}T{m['time']}" for m in known], dtype="datetime64[ns]")
    except ValueError:  # no such date, as the 31st of February
        return None
    return np.asarray((stamps - stamps[0]).astype(np.float64) * 1e-9)


def unique(names: Sequence[str]) -> list[str]:
    """Make names unique: the second ``a`` becomes ``a (2)``."""
    seen: dict[str, int] = {}
    result = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        result.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return result


def without_end(values: np.ndarray) -> np.ndarray:
    """Drop the values of a column after its last finite number."""
    known = np.flatnonzero(np.isfinite(values))
    return values[: known[-1] + 1] if known.size else values[:0]
