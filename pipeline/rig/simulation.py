"""Parse and validate the TOML specification of a virtual rig."""

from __future__ import annotations

import math
from collections.abc import Mapping as AnyMapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from magpend_core.models.model import Model, Parameters
from magpend_core.models.parameters import ParameterError
from magpend_core.models.presets import find_preset
from pipeline.rig.recordings.mapping import DRIVE, Mapping, TimeMap
from pipeline.rig.recordings.raw import Raw
from pipeline.rig.virtual import DriveSensor, Sensor, Step, readings
from pipeline.specification.files import read_toml
from pipeline.specification.models import add_model
from pipeline.specification.problems import SpecError, checked, table_at, unknown_key, unknown_name
from pipeline.specification.starts import degrees_key, state_keys, state_of_key
from pipeline.specification.tables import Table


class SensorTable(Table):
    """Table ``[sensors.STATE]``: kind, noise and resolution of the sensor of one state."""

    kind: Literal["potentiometer", "encoder"] = Field(description="Potentiometer (wraps, 0 to 5 V) or encoder.")
    noise: float = Field(default=0.0, ge=0.0, description="Standard deviation [the state's unit].")
    bits: Annotated[int, Field(ge=1, le=32)] | None = Field(default=None, description="Resolution.")
    dead_band: float = Field(default=0.0, ge=0.0, lt=math.pi, description="Part of a turn that is not measured [rad].")


class SweepTable(Table):
    """Table ``sweep`` of the drive: evenly spaced frequencies, each held for the same number of periods."""

    start_hz: float = Field(gt=0.0, description="First frequency [Hz].")
    stop_hz: float = Field(gt=0.0, description="Last frequency [Hz]; below the first to sweep downwards.")
    num: int = Field(ge=2, le=10_000, description="Number of frequencies.")
    n_periods: int = Field(ge=1, description="Drive periods at each frequency.")


class DriveTable(Table):
    """Table ``[drive]``: the drive's steps of constant frequency, and how the drive is recorded."""

    kind: Literal["torque", "signal"] = Field(default="signal", description="Recorded quantity.")
    noise: float = Field(default=0.0, ge=0.0, description="Standard deviation [N m, or V].")
    steps: Annotated[tuple[dict[str, float], ...], Field(strict=False, min_length=1)] | None = Field(
        default=None, description="Steps, one table each: frequency_hz, n_periods, and parameters that differ."
    )
    sweep: SweepTable | None = Field(default=None, description="Evenly spaced steps, instead of steps.")

    @model_validator(mode="after")
    def _one_of_both(self) -> DriveTable:
        if (self.steps is None) == (self.sweep is None):
            raise ValueError("give steps or sweep, one of them.")
        return self

    def tables(self) -> list[dict[str, float]]:
        """Return the steps of the drive as tables; a sweep is expanded into steps."""
        if self.sweep is None:
            return [dict(table) for table in self.steps or ()]
        s = self.sweep
        values = np.linspace(s.start_hz, s.stop_hz, s.num).tolist()
        return [{"frequency_hz": value, "n_periods": s.n_periods} for value in values]


class RigTable(Table):
    """Top level of the specification: model, parameters, initial state, sampling, drive and sensors."""

    model: str | dict[str, Any] = Field(description="Model, as in a specification: a name, a file or a table.")
    preset: str | None = Field(default=None, description="Preset of the model; by default the first.")
    parameters: dict[str, float] = Field(default={}, description="Values that differ from the preset [SI].")
    initial_state: dict[str, float] = Field(
        default={}, description="States by name, angles and rates also with _deg; the others are 0."
    )
    sampling_rate_hz: float = Field(gt=0.0, description="Sampling rate of all channels [Hz].")
    duration_s: float | None = Field(
        default=None, gt=0.0, description="Length [s]; by default the length of the drive's steps."
    )
    seed: int = Field(default=0, ge=0, description="Seed of the noise.")
    drive: DriveTable | Literal["none"] = Field(default="none", description="Drive of the rig.")
    sensors: dict[str, SensorTable] = Field(default={}, description="Sensors by state.")


NUMBERS = ("sampling_rate_hz", "duration_s", "seed")
"""Keys at the top that are single numbers."""


@dataclass(frozen=True)
class Rig:
    """Validated specification of a virtual rig: parameters, initial state, sample times, drive and sensors."""

    parameters: Parameters
    initial_state: tuple[float, ...]  # initial state in the model's units
    times: np.ndarray  # times of the samples, (n,) [s]
    drive: tuple[Step, ...] | None  # steps of the drive; None for none
    sensors: AnyMapping[str, Sensor | DriveSensor]  # sensors by name of a state, and of the drive
    seed: int


def load_rig(path: str | Path) -> Rig:
    """Read and validate the TOML specification of a virtual rig.

    Raises
    ------
    SpecError
        With all problems at once; also if the file cannot be read or is not TOML.
    """
    return parse_rig(read_toml(path), Path(path).parent)


def parse_rig(data: AnyMapping[str, Any], folder: str | Path = ".") -> Rig:
    """Validate the tables of a virtual rig's specification; the path of a preset file is relative to `folder`.

    Raises
    ------
    SpecError
        With all problems at once.
    """
    keys = tuple(RigTable.model_fields)
    problems = [unknown_key(key, key, keys) for key in data if key not in keys]
    numbers = checked(RigTable, {"model": "-", **{k: data[k] for k in NUMBERS if k in data}}, "", problems)
    drive = None
    if data.get("drive", "none") != "none":
        drive = checked(DriveTable, data["drive"], DRIVE, problems)
    sensors = {
        name: checked(SensorTable, table, f"sensors.{name}", problems)
        for name, table in table_at(data, "sensors", problems).items()
    }
    parameters = rig_parameters(data, folder, problems)
    if parameters is None:
        raise SpecError(problems)
    start = _start(table_at(data, "initial_state", problems), parameters.model, problems)
    steps = _steps(drive, parameters, problems)
    if numbers is not None and drive is None and numbers.duration_s is None:
        problems.append("duration_s: missing; without drive nothing else says how long to record [s].")
    if not sensors:
        problems.append("sensors: missing; add a table [sensors.STATE] for each measured state.")
    if problems:
        raise SpecError(problems)
    duration = numbers.duration_s or sum(step.duration_s for step in steps or ())
    times = np.arange(max(math.floor(duration * numbers.sampling_rate_hz * (1.0 + 1e-12)), 2))
    own: dict[str, Sensor | DriveSensor] = {name: Sensor(**dict(table)) for name, table in sensors.items()}
    if drive is not None:
        own[DRIVE] = DriveSensor(drive.kind, drive.noise)
    return Rig(parameters, start, times / numbers.sampling_rate_hz, steps, own, numbers.seed)


def simulated(rig: Rig, *, is_csv: bool = False) -> tuple[Raw, Mapping]:
    """Simulate a virtual rig. Return its readings, and the mapping (description of the channels) for the file that they
    are written to.

    Parameters
    ----------
    rig
        The specification.
    is_csv
        Whether the file is a CSV file, which has a column of time.

    Raises
    ------
    SpecError
        If sensors, drive and duration do not fit one another.
    ArithmeticError
        If the trajectory diverges or meets the step limit.
    """
    raw, mapping = readings(rig.parameters, rig.drive, rig.initial_state, rig.times, sensors=rig.sensors, seed=rig.seed)
    if is_csv:
        mapping = mapping.model_copy(update={"time": TimeMap(channel="time")})
    return replace(raw, path=Path("simulated")), mapping


def rig_parameters(data: AnyMapping[str, Any], folder: str | Path, problems: list[str]) -> Parameters | None:
    """Return the parameters of a virtual rig from its tables. If they are not valid, add the errors to `problems` and
    return None.
    """
    if "model" not in data:
        problems.append("model: missing; name the model, as magpend models lists them.")
        return None
    model = add_model(data["model"], folder, problems)
    if model is None:
        return None
    overrides = table_at(data, "parameters", problems)
    preset = data.get("preset")
    try:
        return model.load(None if preset is None else find_preset(preset, folder), **overrides)
    except ParameterError as error:
        problems += [f"parameters: {p}" for p in error.problems]
        return None


def _start(given: AnyMapping[str, Any], model: Model, problems: list[str]) -> tuple[float, ...]:
    values = dict.fromkeys(model.state_names, 0.0)
    for key, value in given.items():
        name = state_of_key(key, model)
        if name is None:
            problems.append(f"initial_state.{key}: {unknown_name('state', key, state_keys(model))}")
        elif isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            problems.append(f"initial_state.{key} = {value!r}: must be a finite number.")
        elif key != name and name in given:
            problems.append(f"initial_state: {name} and {degrees_key(name)} are both given; keep one.")
        else:
            values[name] = math.radians(value) if key != name else float(value)
    return tuple(values.values())


def _steps(drive: DriveTable | None, parameters: Parameters, problems: list[str]) -> tuple[Step, ...] | None:
    if drive is None:
        return None
    steps = []
    for i, own in enumerate(drive.tables()):
        frequency, count = own.pop("frequency_hz", math.nan), own.pop("n_periods", math.nan)
        path = f"drive.steps[{i}]"
        if not frequency > 0.0:
            problems.append(f"{path}.frequency_hz: must be there, and above 0 [Hz].")
        elif not (count >= 1 and float(count).is_integer()):
            problems.append(f"{path}.n_periods: must be there, a whole number of 1 or more.")
        else:
            steps.append(Step(float(frequency), int(count), own))
        try:
            parameters.replace(**own)
        except ParameterError as error:
            problems += [f"{path}: {p}" for p in error.problems]
    return tuple(steps)
