"""Read a recording into a dataset with names and SI units, by means of its mapping file."""

from __future__ import annotations

from collections.abc import Mapping as AnyMapping
from collections.abc import Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from pipeline.layout.vocabulary import model_attribute
from pipeline.rig.recordings import checks, units
from pipeline.rig.recordings.channels import Channel, Finding, Raw, findings_of, to_json
from pipeline.rig.recordings.clock import Clock, clock_of, resampled
from pipeline.rig.recordings.mapping import (
    DRIVE,
    ChannelMap,
    CsvMap,
    DriveMap,
    Mapping,
    PieceMap,
    Scaled,
    TimeMap,
    load_mapping,
)
from pipeline.specification.problems import SpecError, unknown_name

# ---- formats ---------------------------------------------------------------------------------------

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
    """Return the stated format of a file, otherwise that of its suffix."""
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
    """Read all channels of a recording's file with the reader for its format, which by default the suffix gives."""
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


# ---- recordings ------------------------------------------------------------------------------------

DIM = "sample"


def read_recording(
    path: str | Path, mapping: Mapping | str | Path, *, window_s: tuple[float, float] | None = None
) -> xr.Dataset:
    """Read a recording by means of its mapping file, and check its channels for faults.

    Parameters
    ----------
    path
        A TDMS, LVM, CSV or MATLAB file.
    mapping
        Mapping of its channels, or the path of the mapping's file.
    window_s
        Start and end of the part to keep [s since the first sample]; takes precedence over the mapping's.

    Returns
    -------
    Dataset
        Over the dim ``sample``: the coords ``time`` [s since the recording's first sample] and ``piece``, a
        number for each stretch without a gap; the mapped quantities in SI units, under the names of the
        model's states; ``drive``, if there is one. NaN marks samples that were not measured. The attributes
        hold the file, the mapping and the findings (see `findings_of`); every correction is a finding.

    Raises
    ------
    SpecError
        If the file or the mapping cannot be read, a channel is missing, the channels have different sampling
        rates, or the window is empty.
    """
    chosen = mapping if isinstance(mapping, Mapping) else load_mapping(mapping)
    raw = read_raw(Path(path), chosen.format, chosen.csv)
    return recording_of(raw, chosen, window_s=window_s)


def recording_of(raw: Raw, mapping: Mapping, *, window_s: tuple[float, float] | None = None) -> xr.Dataset:
    """Convert the channels already read from a file to a recording. See `read_recording`."""
    columns = _resolved(raw, mapping)
    findings = list(raw.findings)
    parts = [_timed(s, mapping, columns, findings) for s in raw.stretches]
    stretches, numbers = [part[0] for part in parts], np.concatenate([part[1] for part in parts])
    clock = clock_of(stretches, mapping.sampling_rate_hz, str(raw.path), numbers=numbers, apart=raw.apart)
    findings += [*clock.findings, *_name_findings(mapping, columns), *_unit_findings(raw, mapping, columns)]
    variables: dict[str, np.ndarray] = {}
    for name in _entries(mapping):
        signal = checks.Signal(name, _joined(stretches, name, clock), clock.time, clock.piece)
        variables[name], found = _converted(signal, mapping)
        findings += found
    _make_absolute(variables, mapping)
    ds = _labelled(variables, clock, raw, mapping, findings)
    part = window_s or mapping.window_s
    return ds if part is None else window(ds, part)


def window(ds: xr.Dataset, window_s: tuple[float, float]) -> xr.Dataset:
    """Return the part of a recording in a time window, with the findings there. Times still count from the start of the
    whole recording.

    Parameters
    ----------
    ds
        A recording.
    window_s
        First and last time [s since the recording's first sample].

    Raises
    ------
    SpecError
        If the window holds fewer than two samples.
    """
    time = ds["time"].values
    low, high = window_s
    slack = 1e-6 / float(ds.attrs["sampling_rate_hz"])
    inside = (time >= low - slack) & (time <= high + slack)
    if int(inside.sum()) < 2:
        raise SpecError(
            f"window_s = [{low:g}, {high:g}]: holds {int(inside.sum())} samples; the recording "
            f"{Path(str(ds.attrs.get('file', ''))).name} goes from {time[0]:g} to {time[-1]:g} s."
        )
    kept = [f for f in findings_of(ds) if not (f.end_s < low - slack or f.start_s > high + slack)]
    return ds.isel({DIM: np.flatnonzero(inside)}).assign_attrs(findings=to_json(kept))


def _entries(mapping: Mapping) -> dict[str, Scaled]:
    drive = mapping.drive_map
    return {**mapping.channels, **({DRIVE: drive} if drive is not None else {})}


def _resolved(raw: Raw, mapping: Mapping) -> dict[str, str]:
    """Return the file's channel of each quantity, of ``time`` and ``piece``; raise `SpecError` for missing ones."""
    wanted: dict[str, Scaled | TimeMap | PieceMap] = dict(_entries(mapping))
    for name, axis in (("time", mapping.time), ("piece", mapping.piece)):
        if axis is not None:
            wanted[name] = axis
    found, problems = {}, []
    for name, entry in wanted.items():
        key, channel = f"channels.{name}" if name in mapping.channels else name, entry.channel
        own = _name_of(channel, raw.names) or _name_but_for_unit(entry, raw.names)
        if own is None:
            told = unknown_name("channel", str(channel), raw.names or ("none",))
            hint = _unit_hint(entry, raw.names)
            problems.append(f"{key}.channel = {channel!r}: {raw.path.name} has no such channel: {told}{hint}")
        elif any(own not in stretch for stretch in raw.stretches):
            problems.append(f"{key}.channel = {channel!r}: is not in all stretches of {raw.path.name}.")
        else:
            found[name] = own
    if problems:
        raise SpecError(problems)
    return found


def _name_of(channel: str | int, names: Sequence[str]) -> str | None:
    if isinstance(channel, int):
        return names[channel - 1] if channel <= len(names) else None
    if channel in names:
        return channel
    near = [name for name in names if name.strip() == channel.strip()]
    return near[0] if len(near) == 1 else None


def _name_but_for_unit(entry: Scaled | TimeMap | PieceMap, names: Sequence[str]) -> str | None:
    """Return the one channel whose name is the mapping's followed by a unit in brackets, else None."""
    near = _names_with_unit(entry.channel, names)
    if len(near) != 1 or isinstance(entry, PieceMap) or not entry.unit:
        return None
    name, stated = near[0]
    # the unit of time stamps has a default, so it must agree with the file's
    if isinstance(entry, TimeMap) and units.factor(units.spelled(stated), "s") != units.factor(entry.unit, "s"):
        return None
    return name


def _names_with_unit(channel: str | int, names: Sequence[str]) -> list[tuple[str, str]]:
    return units.names_with_unit(channel, names) if isinstance(channel, str) else []


def _unit_hint(entry: Scaled | TimeMap | PieceMap, names: Sequence[str]) -> str:
    near = _names_with_unit(entry.channel, names)
    if len(near) != 1 or isinstance(entry, PieceMap):
        return ""
    return f" Write the whole name, or add unit = {near[0][1]!r}."


def _name_findings(mapping: Mapping, columns: dict[str, str]) -> list[Finding]:
    given: dict[str, str | int] = {name: entry.channel for name, entry in _entries(mapping).items()}
    if mapping.time is not None:
        given["time"] = mapping.time.channel
    return [
        Finding(
            "name",
            name,
            text=f"the file's channel is {columns[name]!r}, the mapping's {channel!r}; it is taken for the same.",
        )
        for name, channel in given.items()
        if isinstance(channel, str) and channel.strip() != columns[name].strip()
    ]


def _timed(
    stretch: AnyMapping[str, Channel], mapping: Mapping, columns: dict[str, str], findings: list[Finding]
) -> tuple[dict[str, Channel], np.ndarray]:
    """Return the mapped channels of a stretch under the model's names and with time stamps, and the piece number of
    each sample.

    Channels longer than the time stamps or the piece numbers are cut, with a finding.
    """
    chosen = {name: replace(stretch[columns[name]], name=name) for name in _entries(mapping)}
    axes = {name: stretch[columns[name]].values for name in ("time", "piece") if name in columns}
    for name, values in axes.items():
        for own, channel in chosen.items():
            if len(channel) > len(values):
                text = f"has {len(channel)} samples, the channel of {name} {len(values)}; the last are left out."
                findings.append(Finding("length", own, text=text))
                chosen[own] = replace(channel, values=channel.values[: len(values)])
        longest = max(map(len, chosen.values()))
        if len(values) > longest:
            text = f"has {len(values)} samples, the longest channel {longest}; the last are left out."
            findings.append(Finding("length", name, text=text))
    if mapping.time is not None:
        stamps = (units.factor(mapping.time.unit, "s") or 1.0) * axes["time"]
        chosen = {name: replace(c, time=stamps[: len(c)]) for name, c in chosen.items()}
    first = next(iter(chosen.values()))
    numbers = axes.get("piece", np.zeros(len(first)))[: len(first)]
    if mapping.resample is None:
        return chosen, numbers
    even = {name: resampled(c, mapping.resample) for name, c in chosen.items()}
    before = np.searchsorted(np.asarray(first.time), np.asarray(even[first.name].time), side="right") - 1
    return even, numbers[before]


def _joined(stretches: Sequence[AnyMapping[str, Channel]], name: str, clock: Clock) -> np.ndarray:
    return np.concatenate(
        [s[name].values[slice(*taken[name])] for s, taken in zip(stretches, clock.taken, strict=True)]
    )


def _converted(signal: checks.Signal, mapping: Mapping) -> tuple[np.ndarray, list[Finding]]:
    """Check the readings of a channel for faults; return them in SI units, and the findings."""
    entry = _entries(mapping)[signal.name]
    found = checks.missing(signal)
    raw = np.where(np.isfinite(signal.raw), signal.raw, np.nan)
    value = mapping.factor_of(signal.name) * (raw - entry.zero) + entry.offset
    if isinstance(entry, DriveMap):
        return value, found + checks.constant(signal, "note")
    assert isinstance(entry, ChannelMap)
    dead, in_band = checks.in_dead_band(signal, entry)
    found += checks.constant(signal) + checks.saturated(signal, entry) + in_band
    value[dead] = np.nan
    if mapping.unit_of(signal.name) == "rad":
        value, wraps = checks.unwrapped(signal, value, entry.wraps)
        found += wraps + checks.leaps(signal, value)
    return value, found


def _make_absolute(variables: dict[str, np.ndarray], mapping: Mapping) -> None:
    """Add to each relative angle the angle to which it is relative, so that it becomes absolute."""
    own = dict(variables)
    for name, entry in mapping.channels.items():
        if entry.relative_to is not None:
            variables[name] = own[name] + own[entry.relative_to]


def _unit_findings(raw: Raw, mapping: Mapping, columns: dict[str, str]) -> list[Finding]:
    findings = []
    for name, entry in _entries(mapping).items():
        stated = units.spelled(raw.stretches[0][columns[name]].unit)
        own = units.spelled(entry.unit or mapping.unit_of(name))
        if stated and not units.same(stated, own):
            findings.append(
                Finding("unit", name, text=f"the file says {stated!r}, the mapping {own!r}; the mapping's is used.")
            )
    return findings


def _labelled(
    variables: AnyMapping[str, np.ndarray], clock: Clock, raw: Raw, mapping: Mapping, findings: list[Finding]
) -> xr.Dataset:
    model = mapping.system
    meanings = {s.name: s.meaning for s in model.states} | {q.name: q.meaning for q in model.quantities}
    data: dict[str, Any] = {}
    for name, values in variables.items():
        attrs = {"units": mapping.unit_of(name), "long_name": meanings.get(name, "drive")}
        if name == DRIVE and mapping.drive_map is not None:
            kind = mapping.drive_map.kind
            attrs |= {"kind": kind, "long_name": "driving torque" if kind == "torque" else "signal of the drive"}
        data[name] = (DIM, values, attrs)
    coords = {
        "time": (DIM, clock.time, {"units": "s", "long_name": "time since the recording's first sample"}),
        "piece": (DIM, clock.piece, {"units": "1", "long_name": "stretch without a gap"}),
    }
    about: dict[str, Any] = {
        "sampling_rate_hz": 1.0 / clock.step_s,
        "file": str(raw.path),
        "sha256": raw.sha256,
        "format": raw.format,
        "mapping": mapping.toml(),
        "model": model_attribute(mapping.system),
        "findings": to_json(findings),
        "magpend_version": metadata.version("magpend"),
    }
    if raw.simulated:
        about["simulated"] = 1
    return xr.Dataset(data, coords=coords, attrs=about)
