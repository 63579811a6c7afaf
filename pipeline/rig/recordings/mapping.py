"""Define a recording's mapping file: which channel holds which quantity, and how it is converted to SI units."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping as AnyMapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, model_validator

from magpend_core.models import load_model
from magpend_core.models.model import Model
from pipeline.rig.recordings import units
from pipeline.specification.files import model_toml, read_toml, toml_key, toml_value
from pipeline.specification.models import KEPT, add_model, kept_reference
from pipeline.specification.problems import SpecError, checked, unknown_key
from pipeline.specification.tables import Table

DRIVE = "drive"
"""Name of the drive in a recording's dataset."""

Name = Annotated[str, Field(min_length=1)] | Annotated[int, Field(ge=1)]
Pair = Annotated[tuple[float, float], Field(strict=False)]
Positive = Annotated[float, Field(gt=0)]


class Scaled(Table):
    """Channel with its conversion to SI units: ``sign*scale*unit*(raw - zero) + offset``."""

    channel: Name = Field(description="Name in the file, or the number of its column, from 1.")
    unit: str = Field(default="", description="Unit in the file; by default the quantity's.")
    scale: float | None = Field(
        default=None, description="SI units per unit of the file, for a unit that is not the quantity's."
    )
    zero: float = Field(default=0.0, description="Reading at which the quantity is 0 [the file's unit].")
    offset: float = Field(default=0.0, description="Added after scaling [SI units].")
    sign: Literal[-1, 1] = Field(default=1, description="-1 if the channel counts in the other direction.")


class ChannelMap(Scaled):
    """Table ``[channels.NAME]``: channel of a measured quantity; NAME is a quantity of the model, such as a state."""

    range: Pair | None = Field(default=None, description="Ends of the sensor's range [the file's unit].")
    wraps: bool = Field(default=False, description="Whether the reading jumps back once a turn.")
    dead_band: Pair | None = Field(
        default=None, description="Range of readings in which the sensor does not measure [the file's unit]."
    )
    relative_to: str | None = Field(
        default=None, description="Channel to which this angle is relative; its angle is added."
    )

    @model_validator(mode="after")
    def _rise(self) -> ChannelMap:
        for key in ("range", "dead_band"):
            pair = getattr(self, key)
            if pair is not None and pair[1] <= pair[0]:
                raise ValueError(f"{key} = {list(pair)!r}: the second number must be the greater one.")
        return self


class DriveMap(Scaled):
    """Table ``[drive]``: channel of the drive torque, or of a signal that switches with the drive."""

    kind: Literal["torque", "signal"] = Field(description="A torque [N m], or the level of a signal.")


class TimeMap(Table):
    """Key ``time``: channel with the time stamp of each sample."""

    channel: Name = Field(description="Name in the file, or the number of its column, from 1.")
    unit: str = Field(default="s", description="Unit in the file.")


class PieceMap(Table):
    """Key ``piece``: channel whose value changes where a new piece of the recording begins."""

    channel: Name = Field(description="Name in the file, or the number of its column, from 1.")


class CsvMap(Table):
    """Table ``[csv]``: delimiter, decimal sign and header of a CSV file, if they should not be detected."""

    delimiter: Annotated[str, Field(min_length=1, max_length=1)] | None = Field(
        default=None, description="Separator of fields."
    )
    decimal: Literal[".", ","] | None = Field(default=None, description="Decimal sign.")
    header: bool | None = Field(default=None, description="Whether the first row has names.")
    skip_rows: int = Field(default=0, ge=0, description="Rows before the names.")


class Mapping(Table):
    """A recording's mapping file: which quantity of the model each channel holds, with unit and scale.

    The keys are those of the TOML file; `load_mapping` reads and checks one.
    """

    model: str | dict[str, Any] = Field(
        description="Model whose states are measured, as in a specification: a name, a file or a table."
    )
    format: Literal["tdms", "lvm", "csv", "matlab"] | None = Field(
        default=None, description="Format; by default given by the suffix."
    )
    time: TimeMap | None = Field(default=None, description="Channel of time stamps.")
    piece: PieceMap | None = Field(default=None, description="Channel with a number for each piece.")
    sampling_rate_hz: Positive | None = Field(
        default=None, description="Sampling rate, if the file does not state it [Hz]."
    )
    resample: Positive | None = Field(
        default=None,
        description="Rate to which samples with uneven time stamps are interpolated, linearly between neighbours [Hz].",
    )
    window_s: Pair | None = Field(
        default=None, description="Start and end of the part to read [s since the first sample]."
    )
    csv: CsvMap = Field(default=CsvMap(), description="Form of a CSV file.")
    channels: dict[str, ChannelMap] = Field(min_length=1, description="Channels by name of a state.")
    drive: DriveMap | Literal["none"] = Field(default="none", description="Channel of the drive.")

    @property
    def system(self) -> Model:
        """Model whose states are measured."""
        return load_model(self.model)

    @property
    def drive_map(self) -> DriveMap | None:
        """Part of the mapping file that describes the drive's channel; None if the recording has no such channel."""
        return None if isinstance(self.drive, str) else self.drive

    def unit_of(self, name: str) -> str:
        """Return the SI unit of a quantity of the recording."""
        if name == DRIVE:
            return "N m" if self.drive_map is not None and self.drive_map.kind == "torque" else "1"
        return _units(self.system)[name]

    def factor_of(self, name: str) -> float:
        """Return the signed factor that converts the readings of a quantity in the file to SI units."""
        entry: Scaled = self.drive_map if name == DRIVE and self.drive_map else self.channels[name]
        known = units.factor(entry.unit, self.unit_of(name))
        return entry.sign * (1.0 if entry.scale is None else entry.scale) * (1.0 if known is None else known)

    def toml(self) -> str:
        """Return the recording's mapping as the text of a TOML file."""
        plain = self.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
        tables = {key: plain.pop(key) for key in ("csv", "channels", "drive") if isinstance(plain.get(key), dict)}
        model = model_toml(plain.pop("model")).rstrip("\n")
        is_line = not model.startswith("[")
        lines = [model] if is_line else []
        lines += [f"{key} = {toml_value(value)}" for key, value in plain.items()]
        channels = {f"channels.{toml_key(name)}": entry for name, entry in tables.pop("channels", {}).items()}
        for head, table in {**channels, **tables}.items():
            lines += ["", f"[{head}]", *(f"{key} = {toml_value(value)}" for key, value in table.items())]
        lines += [] if is_line else ["", model]
        return "\n".join(lines) + "\n"


def load_mapping(path: str | Path) -> Mapping:
    """Read and validate a recording's mapping file (TOML).

    Parameters
    ----------
    path
        A TOML file.

    Raises
    ------
    SpecError
        With all problems at once; also if the file cannot be read or is not TOML.
    """
    return parse_mapping(read_toml(path), str(path), Path(path).parent)


def parse_mapping(data: AnyMapping[str, Any] | str, source: str = "", folder: str | Path | None = KEPT) -> Mapping:
    """Validate a recording's mapping, given as tables or as the text of a TOML file; `source` names it in messages.

    A model's file is relative to `folder`; None is for kept data: no file is read, nothing is imported. Raise
    `SpecError` with all problems at once.
    """
    tables = tomllib.loads(data) if isinstance(data, str) else dict(data)
    problems: list[str] = []
    model = _model(tables, folder, problems)
    channels = _entries(tables, problems)
    drive = tables.get("drive", "none")
    if isinstance(drive, dict):
        drive = checked(DriveMap, drive, "drive", problems)
    elif drive != "none":
        problems.append(f'drive = {drive!r}: must be "none", or a table [drive] with channel and kind.')
    rest = {key: value for key, value in tables.items() if key not in ("model", "channels", "drive")}
    known = _rest(rest, problems)
    if "resample" in known:
        problems += [
            f"channels.{name}.wraps: nothing can be interpolated where a reading jumps back; resample the file before "
            "it is read."
            for name, channel in channels.items()
            if channel.wraps
        ]
    if model is not None:
        problems += _quantity_problems(model, channels, drive if isinstance(drive, DriveMap) else None)
    if problems:
        raise SpecError([f"{source}: {p}" if source else p for p in problems])
    assert model is not None
    return Mapping(model=kept_reference(model), channels=channels, drive=drive, **known)


def _rest(rest: dict[str, Any], problems: list[str]) -> dict[str, Any]:
    """Validate the keys other than model, channels and drive one by one, so that all problems are reported."""
    found = {}
    for key, value in rest.items():
        if key not in Mapping.model_fields:
            problems.append(unknown_key(key, key, Mapping.model_fields))
            continue
        kinds: dict[str, type[BaseModel]] = {"time": TimeMap, "piece": PieceMap, "csv": CsvMap}
        kind = kinds.get(key)
        if kind is not None:
            found[key] = checked(kind, value, key, problems)
            continue
        probe = {"model": "-", "channels": {"-": {"channel": "-"}}, key: value}
        if checked(Mapping, probe, "", problems) is not None:
            found[key] = tuple(value) if isinstance(value, list) else value
    if found.get("time") is not None and "sampling_rate_hz" in found:
        problems.append("sampling_rate_hz: the time channel gives it; keep time or sampling_rate_hz.")
    if "resample" in found and found.get("time") is None:
        problems.append('resample: needs time stamps; add time = { channel = "NAME" }, or drop the key.')
    if found.get("time") is not None and units.factor(found["time"].unit, "s") is None:
        problems.append(f"time.unit = {found['time'].unit!r}: must be one of {', '.join(units.UNITS['s'])}.")
    window = found.get("window_s")
    if window is not None and window[1] <= window[0]:
        problems.append(f"window_s = {list(window)!r}: the second number must be the greater one.")
    return found


def _model(tables: AnyMapping[str, Any], folder: str | Path | None, problems: list[str]) -> Model | None:
    if "model" not in tables:
        problems.append("model: missing; name the model whose states are measured, as magpend models lists them.")
        return None
    return add_model(tables["model"], folder, problems)


def _entries(tables: AnyMapping[str, Any], problems: list[str]) -> dict[str, ChannelMap]:
    channels = tables.get("channels", {})
    if not isinstance(channels, dict) or not channels:
        problems.append("channels: missing; add a table [channels.STATE] for each measured state of the model.")
        return {}
    found = {}
    for name, entry in channels.items():
        own = checked(ChannelMap, entry, f"channels.{name}", problems)
        if own is not None:
            found[name] = own
    return found


def _units(model: Model) -> dict[str, str]:
    return {s.name: s.unit for s in model.states} | {q.name: q.unit for q in model.quantities}


def _quantity_problems(model: Model, channels: dict[str, ChannelMap], drive: DriveMap | None) -> list[str]:
    problems = []
    known = _units(model)
    for name, entry in channels.items():
        path = f"channels.{name}"
        if name not in known:
            problems.append(unknown_key(path, name, model.state_names))
            continue
        problems += _unit_problems(path, entry, known[name])
        problems += _angle_problems(path, name, entry, channels, known)
    if drive is not None and drive.kind == "torque":
        problems += _unit_problems("drive", drive, "N m")
    return problems


def _unit_problems(path: str, entry: Scaled, wanted: str) -> list[str]:
    known, kind = units.factor(entry.unit, wanted), units.kind_of(entry.unit)
    if entry.scale == 0.0:
        return [f"{path}.scale = 0: must not be 0; give {wanted} per {entry.unit or 'unit of the file'}."]
    if known is None and kind is not None and kind != "s":
        choices = ", ".join(units.UNITS.get(wanted, {wanted: 1.0}))
        return [f"{path}.unit = {entry.unit!r}: is not one of {wanted}; give one of {choices}, or another channel."]
    if known is None and entry.scale is None:
        return [f"{path}.scale: missing; the unit {entry.unit!r} needs one, in {wanted} per {entry.unit}."]
    if known not in (None, 1.0) and entry.scale is not None and abs(entry.scale / known - 1.0) < 0.02:
        return [f"{path}.scale = {entry.scale!r}: the unit {entry.unit!r} is converted already; drop scale, or unit."]
    return []


def _angle_problems(
    path: str, name: str, entry: ChannelMap, channels: dict[str, ChannelMap], known: AnyMapping[str, str]
) -> list[str]:
    problems = []
    if known[name] != "rad":
        problems += [
            f"{path}.{key}: only an angle has one, and {name} is in {known[name]}; drop the key."
            for key, given in (("wraps", entry.wraps), ("dead_band", entry.dead_band is not None))
            if given
        ]
    other = entry.relative_to
    if other is not None and (other not in channels or other == name):
        problems.append(f"{path}.relative_to = {other!r}: must be another channel of this mapping.")
    elif other is not None and channels[other].relative_to is not None:
        problems.append(f"{path}.relative_to = {other!r}: is itself relative; name one that is absolute.")
    elif other is not None and known.get(other) != known[name]:
        problems.append(f"{path}.relative_to = {other!r}: must be in the same unit, {known[name]}.")
    return problems
