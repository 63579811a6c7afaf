"""Read CSV files. The mapping file states delimiter, header and decimal sign; otherwise they are detected."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.rig.recordings.channels import Channel, Finding, Raw, digest
from pipeline.rig.recordings.mapping import CsvMap
from pipeline.specification.problems import SpecError

# ---- numbers in texts ------------------------------------------------------------------------------

_INSTANT = re.compile(
    r"(?:(?P<date>\d{4}-\d\d-\d\d)[T ])?(?P<time>\d\d:\d\d:\d\d(?:\.\d{1,9})?)(?P<zone>Z|[+-]\d\d:?\d\d)?"
)


def read_text(path: Path) -> str:
    """Return the text of a file, decoded as UTF-8 or else as cp1252, which LabVIEW on Windows writes."""
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
    """Convert the columns of text lines with the given indices to numbers, (n_lines, n_columns).

    Fields that are empty, missing or not numbers become NaN.
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

    Their order is that of ISO 8601, with a blank or a T between date and time, and a point or a comma before the
    fraction of a second.
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


# ---- CSV files -------------------------------------------------------------------------------------

SIMULATED = "# simulated"
"""First line of a file with simulated readings."""

DELIMITERS = (";", "\t", ",", " ")

_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]\s*$")


@dataclass(frozen=True)
class _Form:
    """Form of a CSV text: delimiter, decimal sign, number of header rows, and columns."""

    delimiter: str
    decimal: str
    n_columns: int
    n_head: int  # rows before the numbers
    texts: tuple[int, ...]  # indices of columns without numbers


def read_csv(path: Path, stated: CsvMap) -> Raw:
    """Read all columns of a CSV file; `stated` has properties that need not be detected.

    Lines that begin with ``#`` are comments. The first row with names, if there is one, gives the channels' names. A
    second row of names gives their units, as do brackets after a name: ``angle [V]``. Without names the columns are
    ``1``, ``2``, ... Empty fields and texts are NaN, and are dropped after the last number of a column. Dates and times
    of day become seconds since the first. Other texts are left out. Raise `SpecError` if the file is not a table of
    numbers, or can be read in two ways.
    """
    lines = read_text(path).splitlines()
    is_simulated = bool(lines) and lines[0].startswith(SIMULATED)
    rows = [line for line in lines[stated.skip_rows :] if line.strip() and not line.startswith("#")]
    form = _form(path, rows, stated)
    head = [split(line, form.delimiter) for line in rows[: form.n_head]]
    names, units = _names(head, form.n_columns)
    body = rows[form.n_head :]
    findings = []
    last = split(body[-1], form.delimiter)
    if len(body) > 1 and len(last) < len(split(body[-2], form.delimiter)):
        body = body[:-1]
        findings.append(
            Finding("truncated", text=f"the last row has {len(last)} of {form.n_columns} fields; it is left out.")
        )
    found = {}
    for j, values in _columns(body, form).items():
        if np.isfinite(values).any():
            found[names[j]] = Channel(names[j], without_end(values), units[j])
    return Raw(path, "csv", digest(path), (found,), tuple(findings), simulated=is_simulated)


def _columns(body: list[str], form: _Form) -> dict[int, np.ndarray]:
    """Return the numeric columns, and those of dates or times of day as seconds since the first row."""
    numbers = [j for j in range(form.n_columns) if j not in form.texts]
    values = table(body, numbers, form.delimiter, form.decimal)
    found = {j: values[:, k] for k, j in enumerate(numbers)}
    if form.texts:
        parts = [split(line, form.delimiter) for line in body]
        for j in form.texts:
            stamps = instants([row[j] if j < len(row) else "" for row in parts])
            if stamps is not None:
                found[j] = stamps
    return dict(sorted(found.items()))


def _form(path: Path, rows: list[str], stated: CsvMap) -> _Form:
    delimiters = (stated.delimiter,) if stated.delimiter else DELIMITERS
    decimals = (stated.decimal,) if stated.decimal else (".", ",")
    found = []
    for delimiter, decimal in itertools.product(delimiters, decimals):
        if delimiter != decimal:
            form = _try(rows, delimiter, decimal, stated.header)
            if form is not None:
                found.append(form)
    if not found:
        raise SpecError(
            f"{path}: is not a table of numbers with one of the delimiters ; , tab or blank; state "
            "[csv] delimiter, decimal, header or skip_rows in the mapping."
        )
    fewest = min(len(f.texts) for f in found)
    found = [f for f in found if len(f.texts) == fewest]
    # a row of names has as many fields as the rows of numbers
    named = [f for f in found if f.n_head and len(split(rows[0], f.delimiter)) == f.n_columns]
    best = max(f.n_columns for f in named or found)
    chosen = [f for f in named or found if f.n_columns == best]
    ambiguous = {f.decimal for f in found if "," in (f.delimiter, f.decimal)} == {".", ","} and not named
    if ambiguous and any("," in row for row in rows[-2:]):
        raise SpecError(
            f"{path}: a comma may be between fields or in numbers ({rows[-1]!r}); state [csv] decimal = "
            '"," or delimiter = "," in the mapping.'
        )
    return chosen[0]


def _try(rows: list[str], delimiter: str, decimal: str, header: bool | None) -> _Form | None:
    """Return the form of rows read with one delimiter and decimal sign, or None if they do not fit."""
    n_lines = 50  # from which the form of a file is detected
    sample = rows[:n_lines]
    parsed = [[number(part, decimal) for part in split(row, delimiter)] for row in sample]
    late = parsed[len(parsed) // 2 :]
    n_columns = max((len(row) for row in late), default=0)
    fields = [[row[j] for row in late if j < len(row)] for j in range(n_columns)]
    texts = tuple(j for j, own in enumerate(fields) if all(v is None for v in own))
    numbers = [j for j in range(n_columns) if j not in texts]

    def is_body(row: list[float | None]) -> bool:
        own = [row[j] for j in numbers if j < len(row)]
        return None not in own and any(v == v for v in own)

    n_head = next((i for i, row in enumerate(parsed) if is_body(row)), len(parsed))
    if header is not None:
        n_head = max(n_head, 1) if header else 0
    body = parsed[n_head:]
    if not body or not numbers or n_head > n_lines // 2:
        return None
    whole = body[:-1] if len(rows) <= n_lines and len(body) > 1 else body
    if any(len(row) != n_columns for row in whole):
        return None
    n_bad = sum(row[j] is None for row in body for j in numbers if j < len(row))
    if n_bad > 0.1 * len(body) * len(numbers):
        return None
    return _Form(delimiter, decimal, n_columns, n_head, texts)


def _names(head: list[list[str]], n_columns: int) -> tuple[list[str], list[str]]:
    whole = [[part.strip().strip('"').strip() for part in row] for row in head if len(row) == n_columns]
    if not whole:
        return [str(j + 1) for j in range(n_columns)], [""] * n_columns
    names = unique([name or str(j + 1) for j, name in enumerate(whole[0])])
    in_names = [m[1].strip() if (m := _BRACKETS.search(name)) else "" for name in names]
    below = [part.strip("[]() ") for part in whole[1]] if len(whole) > 1 else [""] * n_columns
    return names, [a or b for a, b in zip(in_names, below, strict=True)]
