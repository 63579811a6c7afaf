"""Simulate a virtual rig: integrate a model with its drive, and record it with imperfect sensors.

The readings have noise, finite resolution and dead bands. They go through the same mapping, checks and files
as measured ones, and are marked as simulated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping as AnyMapping
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from magpend_core.models.model import Model, Parameters
from magpend_core.models.parameters import ParameterError
from magpend_core.models.presets import find_preset
from pipeline.rig.recordings.channels import Channel, Raw
from pipeline.rig.recordings.mapping import DRIVE, ChannelMap, DriveMap, Mapping, TimeMap
from pipeline.rig.recordings.reading import recording_of
from pipeline.specification.files import read_toml
from pipeline.specification.models import add_model, kept_reference
from pipeline.specification.problems import SpecError, checked, table_at, unknown_key, unknown_name
from pipeline.specification.starts import degrees_key, state_keys, state_of_key
from pipeline.specification.tables import Table

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Parameters

GROUP = "rig"
"""Group of the channels in a file."""


TURN = 2.0 * math.pi


@dataclass(frozen=True)
class Sensor:
    """Simulated sensor of one state: kind, noise, resolution, dead band and offset."""

    # ``"potentiometer"``: an angle as a voltage from 0 to 5 V, which wraps at half a turn from 0. ``"encoder"``: the
    # state itself, without wraps.
    kind: Literal["potentiometer", "encoder"] = "encoder"
    noise: float = 0.0  # standard deviation of white noise [the state's unit], before it is quantised
    # resolution in bits: of 5 V for a potentiometer, of a turn for an encoder (of 1 unit if the state is no angle).
    # None for full floating-point resolution.
    bits: int | None = None
    dead_band: float = 0.0  # part of a turn in which a potentiometer does not measure, half a turn from 0 [rad]
    offset: float = 0.0  # error that is added to the state [the state's unit]; the mapping does not correct it


@dataclass(frozen=True)
class DriveSensor:
    """Sensor of the drive: it records the torque, or a signal that gives the torque's sign."""

    # ``"torque"``: the model's forcing; ``"signal"``: its sign, as -1 and 1 [V]
    kind: Literal["torque", "signal"] = "signal"
    noise: float = 0.0  # standard deviation of white noise [unit of the kind]


@dataclass(frozen=True)
class Step:
    """Step of the drive: consecutive periods with the same frequency and parameters."""

    frequency_hz: float
    n_periods: int
    # parameters that differ in this step, by name, such as the duty cycle, or an amplitude of 0
    values: AnyMapping[str, float] = field(default_factory=dict)

    @property
    def duration_s(self) -> float:
        """Length of the drive step [s]."""
        return self.n_periods / self.frequency_hz


RECORD_RTOL = 1e-11
"""Relative and absolute tolerance of the integration."""

Sensors = AnyMapping[str, Sensor | DriveSensor]


def record(
    parameters: Parameters,
    drive: Sequence[Step] | None,
    initial_state: Sequence[float] | np.ndarray,
    times: np.ndarray,
    *,
    sensors: Sensors,
    seed: int,
) -> xr.Dataset:
    """Simulate a recording of a model with a given drive and sensors, with the attributes ``simulated`` and
    ``parameters``.

    The drive's steps begin at time 0 and cover the times, which are even and begin at 0; the state is continuous
    between steps. None is for no drive: then set the parameter of its amplitude to 0. Sensors go by the name of a
    state, and of the drive under ``drive``; other states are not recorded.

    Raise `SpecError` with all problems of the arguments, and `ArithmeticError` if the trajectory diverges or meets the
    step limit.
    """
    raw, mapping = readings(parameters, drive, initial_state, times, sensors=sensors, seed=seed)
    lines = [f"{name} = {value!r}" for name, value in parameters.as_dict().items()]
    return recording_of(raw, mapping).assign_attrs(parameters="\n".join(lines))


def readings(
    parameters: Parameters,
    drive: Sequence[Step] | None,
    initial_state: Sequence[float] | np.ndarray,
    times: np.ndarray,
    *,
    sensors: Sensors,
    seed: int,
) -> tuple[Raw, Mapping]:
    """Simulate the sensors' readings, as for `record`; return them with the mapping that converts them to states.

    The channels are ``rig/STATE`` and ``rig/drive``.
    """
    instants = np.asarray(times, dtype=np.float64)
    _check(parameters, drive, instants, sensors)
    step = float(instants[-1] - instants[0]) / (len(instants) - 1)
    states = _states(parameters, drive, np.asarray(initial_state, dtype=np.float64), instants)
    names = parameters.model.state_names
    channels, entries = {}, {}
    seeds = np.random.SeedSequence(seed).spawn(len(names) + 1)
    for i, name in enumerate(names):
        sensor = sensors.get(name)
        if isinstance(sensor, Sensor):
            unit = parameters.model.states[i].unit
            read = _potentiometer if sensor.kind == "potentiometer" else _encoder
            values, entries[name], unit = read(
                f"{GROUP}/{name}", states[:, i] + sensor.offset, unit, sensor, np.random.default_rng(seeds[i])
            )
            channels[f"{GROUP}/{name}"] = Channel(f"{GROUP}/{name}", values, unit, 0.0, step)
    mapped: DriveMap | Literal["none"] = "none"
    sensor = sensors.get(DRIVE)
    if isinstance(sensor, DriveSensor):
        rng = np.random.default_rng(seeds[-1])
        channel, mapped = _drive_channel(parameters, drive, instants, sensor, rng, step)
        channels[channel.name] = channel
    raw = Raw(Path("simulated"), "simulated", "", (channels,), simulated=True)
    return raw, Mapping(model=kept_reference(parameters.model), channels=entries, drive=mapped)


def _check(parameters: Parameters, drive: Sequence[Step] | None, times: np.ndarray, sensors: Sensors) -> None:
    problems = []
    model = parameters.model
    if times.ndim != 1 or len(times) < 2 or times[0] != 0.0 or np.ptp(np.diff(times)) > 1e-6 * times[1]:
        problems.append("times: must be evenly spaced from 0 on, two at least.")
    known = (*model.state_names, DRIVE)
    problems += [f"sensors: {unknown_name('state', name, known)}" for name in sensors if name not in known]
    if not any(name in model.state_names for name in sensors):
        problems.append(f"sensors: no state is measured; add one of {', '.join(model.state_names)}.")
    for name in model.state_names:
        sensor = sensors.get(name)
        if isinstance(sensor, Sensor):
            problems += _sensor_problems(f"sensors.{name}", sensor, model.state(name).on_circle)
    for i, step in enumerate(drive or ()):
        problems += [
            f"drive.steps[{i}]: {unknown_name('parameter', name, model.parameter_names)}"
            for name in step.values
            if name not in model.parameter_names
        ]
        if not (step.frequency_hz > 0.0 and step.n_periods >= 1):
            problems.append(f"drive.steps[{i}]: frequency_hz must be above 0, and n_periods 1 or more.")
    if drive is not None and not problems:
        covered = sum(step.duration_s for step in drive)
        if covered < times[-1] * (1.0 - 1e-9):
            problems.append(
                f"drive.steps: last {covered:.6g} s together, the recording {times[-1]:.6g} s; add periods, "
                "or shorten it."
            )
    if problems:
        raise SpecError(problems)


def _sensor_problems(path: str, sensor: Sensor, is_angle: bool) -> list[str]:
    problems = []
    if sensor.kind == "potentiometer" and not is_angle:
        problems.append(f'{path}.kind = "potentiometer": measures angles alone; take "encoder".')
    if not math.isfinite(sensor.offset):
        problems.append(f"{path}.offset = {sensor.offset!r}: must be a finite number.")
    if not sensor.noise >= 0.0:
        problems.append(f"{path}.noise = {sensor.noise!r}: must be 0 or more.")
    if sensor.bits is not None and not 1 <= sensor.bits <= 32:
        problems.append(f"{path}.bits = {sensor.bits!r}: must be from 1 to 32.")
    if not 0.0 <= sensor.dead_band < math.pi:
        problems.append(f"{path}.dead_band = {sensor.dead_band!r}: must be from 0 to less than half a turn.")
    if sensor.dead_band and sensor.kind == "encoder":
        problems.append(f'{path}.dead_band: an encoder has none; take kind = "potentiometer".')
    return problems


def _states(parameters: Parameters, drive: Sequence[Step] | None, start: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Integrate the model; return its states at the sample times, (n, n_states), angles not wrapped."""
    from magpend_core.sampling import sample
    from magpend_core.status import Status

    drives = None if drive is None else [_intervals(parameters, drive, times[-1])]
    # tighter than any fit to the recording, so that its errors are the sensors' alone
    found = sample(
        parameters.model.system,
        parameters.pack()[None],
        start[None],
        [times],
        drives=drives,
        rtol=RECORD_RTOL,
        atol=RECORD_RTOL,
    )
    status = Status(int(found.status[0]))
    if not np.isfinite(found.states[0]).all():
        raise ArithmeticError(f"The trajectory ended early: {status.advice}.")
    return np.asarray(found.states[0])


def _intervals(parameters: Parameters, drive: Sequence[Step], end_s: float) -> Any:
    """Return the drive period by period: durations, and values of the parameters that differ between steps."""
    from magpend_core.sampling import Drive

    names = tuple(dict.fromkeys(name for step in drive for name in step.values))
    rows = [[step.values.get(name, parameters[name]) for name in names] for step in drive]
    counts = [step.n_periods for step in drive]
    durations = np.repeat([1.0 / step.frequency_hz for step in drive], counts)
    # rounding must not leave the last sample outside
    durations[-1] += max(end_s - float(durations.sum()), 0.0)
    return Drive(durations, names, np.repeat(np.array(rows).reshape(len(drive), len(names)), counts, axis=0))


def _potentiometer(
    channel: str, angle: np.ndarray, unit: str, sensor: Sensor, rng: np.random.Generator
) -> tuple[np.ndarray, ChannelMap, str]:
    # voltages at the ends of the track, and the one below which the wiper is off it, where a resistor pulls it to 0 V
    track_v, dead_v, supply_v = (0.25, 4.75), 0.1, 5.0
    low, high = track_v
    middle, per_rad = 0.5 * (low + high), (high - low) / (TURN - sensor.dead_band)
    folded = np.mod(angle + math.pi, TURN) - math.pi
    volts = middle + per_rad * folded
    is_off = np.abs(folded) > math.pi - 0.5 * sensor.dead_band
    volts[is_off] = 0.0
    noisy = np.clip(volts + per_rad * sensor.noise * rng.standard_normal(len(volts)), 0.0, supply_v)
    if sensor.bits is not None:
        grain = supply_v / (2**sensor.bits - 1)
        noisy = grain * np.round(noisy / grain)
    entry = ChannelMap(
        channel=channel,
        unit="V",
        scale=1.0 / per_rad,
        zero=middle,
        range=(0.0, supply_v),
        wraps=True,
        dead_band=(0.0, dead_v) if sensor.dead_band else None,
    )
    return noisy, entry, "V"


def _encoder(
    channel: str, state: np.ndarray, unit: str, sensor: Sensor, rng: np.random.Generator
) -> tuple[np.ndarray, ChannelMap, str]:
    noisy = state + sensor.noise * rng.standard_normal(len(state))
    if sensor.bits is None:
        return noisy, ChannelMap(channel=channel, unit=unit), unit
    grain = (TURN if unit == "rad" else 1.0) / 2**sensor.bits
    return np.round(noisy / grain), ChannelMap(channel=channel, unit="counts", scale=grain), "counts"


def _drive_channel(
    parameters: Parameters,
    drive: Sequence[Step] | None,
    times: np.ndarray,
    sensor: DriveSensor,
    rng: np.random.Generator,
    step_s: float,
) -> tuple[Channel, DriveMap]:
    from magpend_core.pointwise import drive_level

    level = np.zeros(len(times))
    begin = 0.0
    for step in drive or ():
        end = begin + step.duration_s
        inside = (times >= begin - 1e-12) & (times < end - 1e-12)
        own = parameters.replace(**dict(step.values))
        # a sample on an edge belongs to the interval after it
        level[inside] = drive_level(times[inside] - begin + 1e-12, own, step.frequency_hz)
        begin = end
    if sensor.kind == "signal":
        level = np.sign(level)
    name, unit = f"{GROUP}/{DRIVE}", "V" if sensor.kind == "signal" else "N m"
    values = level + sensor.noise * rng.standard_normal(len(level))
    return Channel(name, values, unit, 0.0, step_s), DriveMap(channel=name, unit=unit, kind=sensor.kind)


# ---- specification ---------------------------------------------------------------------------------


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
    """Read and validate the TOML specification of a virtual rig; raise `SpecError` with all problems at once."""
    return parse_rig(read_toml(path), Path(path).parent)


def parse_rig(data: AnyMapping[str, Any], folder: str | Path = ".") -> Rig:
    """Validate the tables of a virtual rig, with paths relative to `folder`; raise `SpecError` with all problems."""
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
    """Simulate a virtual rig. Return its readings, and the mapping for the file that they are written to.

    A CSV file has a column of time. See `record` for errors.
    """
    raw, mapping = readings(rig.parameters, rig.drive, rig.initial_state, rig.times, sensors=rig.sensors, seed=rig.seed)
    if is_csv:
        mapping = mapping.model_copy(update={"time": TimeMap(channel="time")})
    return replace(raw, path=Path("simulated")), mapping


def rig_parameters(data: AnyMapping[str, Any], folder: str | Path, problems: list[str]) -> Parameters | None:
    """Return the parameters of a virtual rig; if its tables are not valid, add problems and return None."""
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
