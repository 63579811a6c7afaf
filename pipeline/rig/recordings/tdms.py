"""Read TDMS files of LabVIEW with the package npTDMS."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.rig.recordings.channels import Channel, Finding, Raw, digest
from pipeline.specification.problems import SpecError, import_extra

SIMULATED = "simulated"
"""Property of a file with simulated readings."""


_UNITS = ("unit_string", "NI_UnitDescription", "unit")


def read_tdms(path: Path) -> Raw:
    """Read all channels of numbers or times in a TDMS file, under the names ``GROUP/CHANNEL``.

    Waveforms state their sampling interval and start. The start is read with all its digits, while npTDMS by default
    rounds it to microseconds. A last segment shorter than stated, for which npTDMS only warns, is a finding.
    """
    TdmsFile = import_extra("nptdms", "rig", str(path)).TdmsFile
    with _listening() as warnings:
        try:
            file = TdmsFile.read(str(path), raw_timestamps=True)
        except Exception as error:  # npTDMS raises what its parser meets: struct.error, KeyError, ...
            raise SpecError(
                f"{path}: is not a TDMS file that can be read ({error}); write it anew, or export it as CSV."
            ) from None
    found = {}
    zero = _earliest(file)
    for group in file.groups():
        for channel in group.channels():
            values = _numbers(channel[:], zero)
            if values is not None:
                name = f"{group.name}/{channel.name}"
                found[name] = _channel(name, values, channel.properties, zero)
    is_simulated = bool(file.properties.get(SIMULATED, 0))
    findings = tuple(_truncations(path, file, warnings))
    return Raw(path, "tdms", digest(path), (found,), findings, simulated=is_simulated)


def _channel(name: str, values: np.ndarray, properties: Mapping[str, Any], zero: int) -> Channel:
    unit = next((str(properties[key]) for key in _UNITS if properties.get(key)), "")
    start = float(properties.get("wf_start_offset", 0.0))
    if "wf_start_time" in properties:
        start += _seconds(properties["wf_start_time"], zero)
    elif "wf_start_offset" not in properties:
        start = math.nan
    step = float(properties.get("wf_increment", math.nan))
    return Channel(name, values, unit, start, step if step > 0.0 else math.nan)


def _numbers(data: Any, zero: int) -> np.ndarray | None:
    """Return data as floats (time stamps as seconds since `zero`), or None if they are no numbers or times."""
    array = np.asarray(data)
    names = array.dtype.names or ()
    if "second_fractions" in names:
        seconds = (array["seconds"] - zero).astype(np.float64)
        return np.asarray(seconds + array["second_fractions"].astype(np.float64) * 2.0**-64)
    return array.astype(np.float64) if array.dtype.kind in "fiub" and array.ndim == 1 else None


def _earliest(file: Any) -> int:
    """Return the whole second at or before the earliest start: times count from it without loss of digits."""
    starts = [c.properties.get("wf_start_time") for g in file.groups() for c in g.channels()]
    return min((int(s.seconds) for s in starts if s is not None), default=0)


def _seconds(stamp: Any, zero: int) -> float:
    return float(int(stamp.seconds) - zero) + float(stamp.second_fractions) * 2.0**-64


def _truncations(path: Path, file: Any, warnings: list[str]) -> list[Finding]:
    """Report data that the file announces but lacks, by its segment lengths and the warnings of npTDMS."""
    status = file.file_status
    remedy = "copy the file again, or take care that the writing program closes it"
    if status.channel_statuses:
        return [
            _truncated(
                f"the last segment holds {s.read_length} of the {s.expected_length} samples that it states; {remedy}.",
                name.replace("'", "").strip("/"),
            )
            for name, s in status.channel_statuses.items()
            if s.read_length < s.expected_length
        ] or [_truncated(f"the last segment was not closed; {remedy}.")]
    if warnings:
        return [_truncated(f"{text[:1].lower()}{text[1:]}; {remedy}.") for text in warnings]
    rest = _bytes_after_last_segment(path)
    return [_truncated(f"the file ends {rest} bytes into a segment; {remedy}.")] if rest else []


def _bytes_after_last_segment(path: Path) -> int:
    """Return the number of bytes after the last segment with a complete lead-in; npTDMS silently skips them.

    The lead-in of a segment has 28 bytes: tag, table of contents, version, and the lengths of the parts that
    follow (National Instruments, "TDMS File Format Internal Structure").
    """
    # length of a segment's lead-in [bytes], and the flag in the first byte of its table of contents
    lead_in, big_endian = 28, 1 << 6
    size, place = path.stat().st_size, 0
    with path.open("rb") as file:
        while size - place >= lead_in:
            file.seek(place)
            lead = file.read(lead_in)
            order: Literal["big", "little"] = "big" if lead[4] & big_endian else "little"
            place += lead_in + int.from_bytes(lead[12:20], order)
    return max(size - place, 0)


def _truncated(text: str, channel: str = "") -> Finding:
    return Finding("truncated", channel, text=text)


@contextlib.contextmanager
def _listening() -> Iterator[list[str]]:
    """Collect the log messages of npTDMS in a list and keep them from other handlers, as a context manager."""
    heard: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        heard.append(record.getMessage())
        return False

    names = [name for name in logging.root.manager.loggerDict if name.startswith("nptdms")]
    loggers = [logging.getLogger(name) for name in names]
    for logger in loggers:
        logger.addFilter(keep)
    try:
        yield heard
    finally:
        for logger in loggers:
            logger.removeFilter(keep)
