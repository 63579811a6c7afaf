"""Simulate a virtual rig: integrate a model with its drive, and record it with imperfect sensors.

The readings have noise, finite resolution and dead bands. They go through the same mapping, checks and files
as measured ones, and are marked as simulated.
"""

from __future__ import annotations

import math
from collections.abc import Mapping as AnyMapping
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from pipeline.rig.recordings.mapping import DRIVE, ChannelMap, DriveMap, Mapping
from pipeline.rig.recordings.raw import Channel, Raw
from pipeline.rig.recordings.reading import recording_of
from pipeline.specification.models import kept_reference
from pipeline.specification.problems import SpecError, unknown_name

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Parameters

GROUP = "rig"
"""Group of the channels in a file."""

SUPPLY_V = 5.0
TRACK_V = (0.25, 4.75)
"""Voltages at the ends of a potentiometer's track."""

DEAD_V = 0.1
"""Voltage below which the wiper is off the track, where a resistor pulls it to 0 V."""

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


TOLERANCE = 1e-11
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
    """Simulate a recording of a model with a given drive and sensors.

    Parameters
    ----------
    parameters
        The model and its parameters.
    drive
        Steps of the drive from time 0 on; the state is continuous between them. None for no drive: then set
        the parameter of its amplitude to 0.
    initial_state
        The model's states at time 0.
    times
        Evenly spaced times from 0 on, (n,) [s]; the steps must cover them.
    sensors
        Sensors by name of a state, and of the drive under ``drive``; other states are not recorded.
    seed
        Seed of the noise.

    Returns
    -------
    Dataset
        Recording as from `pipeline.rig.recordings.read_recording`, with the attributes ``simulated`` and
        ``parameters`` (the true ones).

    Raises
    ------
    SpecError
        If arguments are wrong; the message lists all problems.
    ArithmeticError
        If the trajectory diverges or meets the step limit.
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
    """Simulate the sensors' readings. Return them with the mapping (description of the channels) that converts them to
    states.

    Returns
    -------
    Raw, Mapping
        Channels ``rig/STATE`` and ``rig/drive`` as they can be written by
        `pipeline.rig.recordings.write_raw`.

    Raises
    ------
    SpecError, ArithmeticError
        See `record`.
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
        rtol=TOLERANCE,
        atol=TOLERANCE,
    )
    status = Status(int(found.status[0]))
    if not np.isfinite(found.states[0]).all():
        raise ArithmeticError(f"The trajectory ended early: {status.sentence}.")
    return np.asarray(found.states[0])


def _intervals(parameters: Parameters, drive: Sequence[Step], end_s: float) -> Any:
    """Return the drive period by period over all its steps: the durations, and the values of the parameters that differ
    between steps.
    """
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
    low, high = TRACK_V
    middle, per_rad = 0.5 * (low + high), (high - low) / (TURN - sensor.dead_band)
    folded = np.mod(angle + math.pi, TURN) - math.pi
    volts = middle + per_rad * folded
    is_off = np.abs(folded) > math.pi - 0.5 * sensor.dead_band
    volts[is_off] = 0.0
    noisy = np.clip(volts + per_rad * sensor.noise * rng.standard_normal(len(volts)), 0.0, SUPPLY_V)
    if sensor.bits is not None:
        grain = SUPPLY_V / (2**sensor.bits - 1)
        noisy = grain * np.round(noisy / grain)
    entry = ChannelMap(
        channel=channel,
        unit="V",
        scale=1.0 / per_rad,
        zero=middle,
        range=(0.0, SUPPLY_V),
        wraps=True,
        dead_band=(0.0, DEAD_V) if sensor.dead_band else None,
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
