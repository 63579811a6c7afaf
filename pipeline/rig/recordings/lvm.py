"""Read LVM files, the text format of LabVIEW: one file header, then segments that each have a header.

Written from National Instruments' description "Specification for the LabVIEW Measurement File (.lvm)".
No text in a file is evaluated. Fields that are not numbers are NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from pipeline.rig.recordings.channels import Channel, Finding, Raw, digest
from pipeline.rig.recordings.delimited import number, read_text, split, table, unique, without_end
from pipeline.specification.problems import SpecError

MAGIC = "LabVIEW Measurement"
END = "***End_of_Header***"
SPECIAL, END_SPECIAL = "***Start_Special***", "***End_Special***"
X_NAME, COMMENT = "X_Value", "Comment"
SEPARATORS = {"Tab": "\t", "Comma": ",", "Space": " ", "Semicolon": ";"}


@dataclass
class _Style:
    """Settings of an LVM file for all its segments: field separator, decimal sign, X columns."""

    separator: str
    decimal: str
    x_columns: str


@dataclass
class _Segment:
    """Segment of an LVM file: header keys, column names, and lines of data."""

    keys: dict[str, list[str]]
    names: list[str]
    lines: list[str]
    first_line: int


def read_lvm(path: Path) -> Raw:
    """Read all channels of all segments of an LVM file.

    Segments with successive times are one recording. The times come from their headers (``Date``, ``Time``, ``X0``,
    ``Delta_X``) and the X columns. Comments are left out. If it is not an LVM file, `SpecError` names the line where
    reading ended.
    """
    lines = read_text(path).splitlines()
    if not lines or not lines[0].strip().startswith(MAGIC):
        raise SpecError(f"{path}: does not begin with {MAGIC!r}, as an LVM file does; is it a CSV file?")
    style, at = _file_header(path, lines)
    segments = _segments(path, lines, at, style)
    zero = min((t for s in segments for t in _instants(s, style).values()), default=0.0)
    stretches, findings = [], []
    for segment in segments:
        channels = _channels(segment, style, zero)
        stretches.append(channels)
        findings += _truncations(segment, channels, style)
    return Raw(path, "lvm", digest(path), tuple(stretches), tuple(findings))


def _file_header(path: Path, lines: list[str]) -> tuple[_Style, int]:
    keys: dict[str, str] = {}
    for i, line in enumerate(lines[1:], 1):
        if line.strip().startswith(END):
            separator = SEPARATORS.get(keys.get("Separator", "Tab"), "\t")
            decimal = keys.get("Decimal_Separator") or "."
            if decimal not in ".,":
                raise SpecError(f"{path}: Decimal_Separator is {decimal!r}; it must be a point or a comma.")
            return _Style(separator, decimal, keys.get("X_Columns", "One")), i + 1
        name, _, value = line.strip().partition("\t" if "\t" in line else ",")
        keys[name.strip()] = value.strip()
    raise SpecError(f"{path}: the header does not end: there is no line {END}; is the file complete?")


def _segments(path: Path, lines: list[str], at: int, style: _Style) -> list[_Segment]:
    found: list[_Segment] = []
    i = at
    while True:
        i = _skip(lines, i)
        if i >= len(lines):
            break
        keys: dict[str, list[str]] = {}
        begin = i
        while i < len(lines) and not lines[i].startswith(END):
            name, *values = (part.strip() for part in split(lines[i], style.separator))
            keys[name] = values
            i += 1
        if i + 1 >= len(lines):
            if found:  # a header that was begun when the file ended
                found[-1].keys["_cut"] = [str(begin + 1)]
                break
            raise SpecError(f"{path}: no data after line {begin + 1}; is the file complete?")
        names = [part.strip() for part in split(lines[i + 1], style.separator)]
        i, first = i + 2, i + 2
        while i < len(lines) and lines[i].strip() and not lines[i].startswith(("***", "Channels")):
            i += 1
        found.append(_Segment(keys, names, lines[first:i], first + 1))
    if not found:
        raise SpecError(f"{path}: has a header and no data.")
    return found


def _skip(lines: list[str], i: int) -> int:
    while i < len(lines):
        if lines[i].startswith(SPECIAL):
            while i < len(lines) and not lines[i].startswith(END_SPECIAL):
                i += 1
        elif lines[i].strip():
            break
        i += 1
    return i


def _columns(segment: _Segment) -> dict[int, int | None]:
    """Map the index of each channel column to that of its abscissa (X) column, or to None."""
    last_x: int | None = None
    found: dict[int, int | None] = {}
    for j, name in enumerate(segment.names):
        if name == X_NAME:
            last_x = j
        elif name and name != COMMENT:
            found[j] = last_x
    return found


def _key(segment: _Segment, name: str, column: int) -> str:
    """Return the value of a header key for one channel column."""
    values = segment.keys.get(name, [])
    place = column - 1 if segment.names[0] == X_NAME else column
    return values[place] if 0 <= place < len(values) else ""


def _number(segment: _Segment, name: str, column: int, style: _Style) -> float:
    value = number(_key(segment, name, column), style.decimal)
    return math.nan if value is None else value


def _instants(segment: _Segment, style: _Style) -> dict[int, float]:
    """Return the start time of each channel column [s since year 1], where the segment's header states it."""
    found = {}
    for j in _columns(segment):
        try:
            year, month, day = (int(part) for part in _key(segment, "Date", j).split("/"))
            hour, minute, second = _key(segment, "Time", j).replace(",", ".").split(":")
            of_day = 3600.0 * int(hour) + 60.0 * int(minute) + float(second)
            days = date(year, month, day).toordinal()
        except ValueError:
            continue
        found[j] = 86400.0 * days + of_day
    return found


def _channels(segment: _Segment, style: _Style, zero: float) -> dict[str, Channel]:
    columns = _columns(segment)
    names = dict(zip(columns, unique([segment.names[j] for j in columns]), strict=True))
    # columns after the last channel, such as comments, are not read
    values = table(segment.lines, range(max(columns, default=-1) + 1), style.separator, style.decimal)
    starts = _instants(segment, style)
    found = {}
    for j, x in columns.items():
        readings = without_end(values[:, j])
        start = starts.get(j, math.nan)
        offset = start - zero if math.isfinite(start) else math.nan
        x0, step = _number(segment, "X0", j, style), _number(segment, "Delta_X", j, style)
        stamps = values[: len(readings), x] if x is not None and style.x_columns != "No" else None
        if stamps is not None and np.isfinite(stamps).any():
            even = x0 + step * np.arange(len(stamps))
            if not np.all(np.abs(stamps - even) <= 0.5 * step):
                own = stamps if math.isnan(offset) else stamps + offset
                found[names[j]] = Channel(names[j], readings, _key(segment, "Y_Unit_Label", j), time=own)
                continue
        x0 = 0.0 if math.isnan(x0) else x0
        begin = x0 if math.isnan(offset) else x0 + offset
        found[names[j]] = Channel(names[j], readings, _key(segment, "Y_Unit_Label", j), begin, step)
    return found


def _truncations(segment: _Segment, channels: dict[str, Channel], style: _Style) -> list[Finding]:
    findings = []
    for j, channel in zip(_columns(segment), channels.values(), strict=True):
        stated = _number(segment, "Samples", j, style)
        if math.isfinite(stated) and len(channel) < stated:
            findings.append(
                Finding(
                    "truncated",
                    channel.name,
                    text=f"the segment from line {segment.first_line} has {len(channel)} of the {stated:.0f} samples "
                    "that its header states.",
                )
            )
    if "_cut" in segment.keys:
        findings.append(
            Finding("truncated", text=f"the file ends within the header that begins in line {segment.keys['_cut'][0]}.")
        )
    return findings
