"""Trace a branch of stable and unstable orbits of a virtual rig, a driven oscillator, by control-based continuation.

A proportional and derivative controller acts through the rig's drive and keeps a state near a periodic target. Its
output is the whole drive. Harmonics of the target other than the first are replaced by those of the response
(Picard iteration) until the output is one cosine. The response is then an orbit of the rig under a drive of this
amplitude, stable or not (Barton and Burrow, J. Comput. Nonlinear Dyn. 6, 2011, 011005; Barton and Sieber, Phys. Rev. E
87, 2013, 052916). A sweep of the target's first harmonic passes folds, where the drive's amplitude turns back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field

from magpend_core import rates
from magpend_core.models.model import Parameters
from pipeline.rig.virtual import rig_parameters
from pipeline.specification.files import read_toml
from pipeline.specification.problems import SpecError, checked, unknown_key, unknown_name
from pipeline.specification.tables import Table

SAMPLES_OF_PERIOD = 128
"""Samples of the controller in each period; its output is constant between two of them."""

TARGET_HARMONICS = 5
"""Harmonics of the target, besides its mean."""


@dataclass(frozen=True)
class Controlled:
    """Settings of a virtual rig under feedback control: model, drive, gains, noise and measuring times."""

    parameters: Parameters  # the rig's; the value of `drive` does not matter
    frequency_hz: float
    state: str  # controlled state; its rate is measured as well
    drive: str  # parameter that is the amplitude of the drive, a cosine
    gains: tuple[float, float] = (2.0, 1.0)  # of the state and of its rate [the drive's unit per theirs]
    noise: float = 0.0  # standard deviation of the measured state; that of its rate is larger by the angular frequency
    # drive periods for which the rig settles after each change of the target, and that are then measured
    n_settle: int = 12
    n_measure: int = 8
    seed: int = 0


@dataclass(frozen=True)
class TracedOrbits:
    """Traced orbits of the rig, one per target: median and standard deviation over the measured drive periods."""

    drive: np.ndarray  # (target,) amplitude of the drive
    # (target,) half of the peak-to-peak value of the state
    amplitude: np.ndarray
    amplitude_sd: np.ndarray
    residue: np.ndarray  # (target,) largest further harmonic of the controller's output, in units of the first
    # ``yes`` where the drive grows along the branch, ``no`` where it falls, ``unknown`` where its scatter hides it
    stable: tuple[str, ...]


def trace(rig: Controlled, targets: Sequence[float] | np.ndarray) -> TracedOrbits:
    """Trace a branch: find one orbit for each amplitude of the target's first harmonic, each with a virtual rig of its
    own.

    Raise `SpecError` if the state has no rate, the drive is no parameter that acts on it as a cosine, or a target is
    not positive, and `ArithmeticError` if control fails: a rig diverges.
    """
    # most Picard iterations, and the largest further harmonic of the output, in units of the first, that ends them
    rounds, smallest = 30, 1e-3
    # iterations in which that harmonic must fall to this share of what it was; if it does not, noise limits it
    patience, least_gain = 3, 0.7
    sizes = np.asarray(targets, np.float64)
    plant = _Plant.of(rig, sizes)
    target = np.zeros((len(sizes), TARGET_HARMONICS + 1), np.complex128)
    target[:, 1] = sizes
    random = np.random.default_rng(rig.seed)
    state = np.zeros((len(sizes), len(rig.parameters.model.state_names)))
    worst: list[float] = []
    for _ in range(rounds):
        state, _, _ = plant.run(state, target, rig.n_settle, random)
        state, seen, output = plant.run(state, target, rig.n_measure, random)
        response, excitation = _harmonics(seen), _harmonics(output)
        others = np.delete(np.abs(excitation), 1, axis=1)
        residue = others.max(axis=1) / np.abs(excitation[:, 1])
        worst.append(float(residue.max()))
        if worst[-1] < smallest or (len(worst) > patience and worst[-1] > least_gain * worst[-1 - patience]):
            break
        target = np.where(np.arange(TARGET_HARMONICS + 1) == 1, target, response)
    cycles = np.stack(np.split(seen, rig.n_measure))
    peaks = 0.5 * np.ptp(cycles, axis=1)
    drives = np.abs([_harmonics(part)[:, 1] for part in np.split(output, rig.n_measure)])
    drive, scatter = np.median(drives, axis=0), np.std(drives, axis=0)
    return TracedOrbits(
        drive, np.median(peaks, axis=0), np.std(peaks, axis=0), residue, _stabilities(sizes, drive, scatter)
    )


@dataclass(frozen=True)
class _Plant:
    """Virtual rigs, one per target: the model without its drive, and the direction in which the control force acts."""

    rig: Controlled
    parameters: Parameters
    place: tuple[int, int]
    push: np.ndarray

    @classmethod
    def of(cls, rig: Controlled, targets: np.ndarray) -> _Plant:
        model, problems = rig.parameters.model, []
        if rig.state not in model.state_names or not model.state(rig.state).rate:
            known = [s.name for s in model.states if s.rate]
            problems.append(f"{unknown_name('state with a rate', rig.state, known)}")
        if rig.drive not in model.parameter_names:
            problems.append(unknown_name("parameter", rig.drive, model.parameter_names))
        if not len(targets) or not (targets > 0.0).all():
            problems.append("targets: must be amplitudes above 0, one at least.")
        if problems:
            raise SpecError(problems)
        still, one = (rig.parameters.replace(**{rig.drive: size}) for size in (0.0, 1.0))
        push = _push(still, one, rig.frequency_hz)
        names = model.state_names
        place = names.index(rig.state), names.index(model.state(rig.state).rate)
        return cls(rig, still, place, push)

    def run(
        self, state: np.ndarray, target: np.ndarray, n_periods: int, random: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Integrate the rigs for some periods; return final states, and measured state and output at each sample."""
        period = 1.0 / self.rig.frequency_hz
        step, omega = period / SAMPLES_OF_PERIOD, 2.0 * np.pi * self.rig.frequency_hz
        orders = np.arange(TARGET_HARMONICS + 1)
        seen, output = (np.empty((n_periods * SAMPLES_OF_PERIOD, len(state))) for _ in range(2))
        for k in range(len(seen)):
            # the controller aims at the middle of its step, since its output is held
            turn = np.exp(1j * omega * orders * (k % SAMPLES_OF_PERIOD) * step)
            aim, aim_rate = (target * turn).sum(axis=1).real, (target * turn * 1j * omega * orders).sum(axis=1).real
            noise = self.rig.noise * random.normal(size=(2, len(state))) if self.rig.noise else np.zeros((2, 1))
            x, v = state[:, self.place[0]] + noise[0], state[:, self.place[1]] + omega * noise[1]
            u = self.rig.gains[0] * (aim - x) + self.rig.gains[1] * (aim_rate - v)
            seen[k], output[k] = x, u
            state = self._step(state, u[:, None] * self.push, step)
        if not np.isfinite(state).all():
            raise ArithmeticError("a rig diverges under control; use other gains or smaller targets.")
        return state, seen, output

    def _step(self, y: np.ndarray, force: np.ndarray, h: float) -> np.ndarray:
        """Integrate over one sampling interval by the classical Runge-Kutta method, with a constant control force."""

        def rate(state: np.ndarray) -> np.ndarray:
            found = rates(np.zeros(len(state)), state, self.parameters, self.rig.frequency_hz)
            return np.asarray(found + force)

        k1 = rate(y)
        k2 = rate(y + 0.5 * h * k1)
        k3 = rate(y + 0.5 * h * k2)
        k4 = rate(y + h * k3)
        return np.asarray(y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))


def _push(still: Parameters, one: Parameters, frequency_hz: float) -> np.ndarray:
    """Return the change of the rates under a drive of amplitude 1 at phase 0; raise SpecError unless it is a cosine."""
    shares = np.array([0.0, 0.125, 0.25, 0.5])
    states = np.stack([np.zeros(len(still.model.state_names)), 0.3 * np.asarray(still.model.scales)])
    found = np.array(
        [
            rates(np.full(2, t / frequency_hz), states, one, frequency_hz)
            - rates(np.full(2, t / frequency_hz), states, still, frequency_hz)
            for t in shares
        ]
    )
    push = found[0, 0]
    expected = np.cos(2.0 * np.pi * shares)[:, None, None] * push
    if not push.any() or np.abs(found - expected).max() > 1e-9 * np.abs(push).max():
        raise SpecError(
            "drive: does not act as amplitude times cos(2 pi f t) in one direction; control acts through such a drive."
        )
    return np.asarray(push)


def _harmonics(signal: np.ndarray) -> np.ndarray:
    """Return the complex Fourier coefficients (target, harmonic) of a signal (sample, target) over whole periods."""
    n = len(signal)
    lines = np.fft.rfft(signal, axis=0)[:: n // SAMPLES_OF_PERIOD][: TARGET_HARMONICS + 1].T / n
    lines[:, 1:] *= 2.0
    return np.asarray(lines)


def _stabilities(targets: np.ndarray, drive: np.ndarray, scatter: np.ndarray) -> tuple[str, ...]:
    """Return the stability of each orbit, from the slope of the drive's amplitude along the branch."""
    # scatters by which the drive's amplitude must change between neighbours for the slope to tell the stability
    sure = 2.0
    if len(targets) < 2:
        return ("unknown",) * len(targets)
    order = np.argsort(targets)
    rises = np.sign(np.where(np.abs(np.diff(drive[order])) > sure * scatter[order].max(), np.diff(drive[order]), 0.0))
    sides = np.stack([np.append(rises[:1], rises), np.append(rises, rises[-1:])])
    found = np.empty(len(targets), object)
    found[order] = np.where(sides[0] != sides[1], "unknown", np.array(["unknown", "yes", "no"])[sides[0].astype(int)])
    return tuple(map(str, found))


# ---- specification -----------------------------------------------------------------------------


class ControlTable(Table):
    """Table ``[control]`` of a virtual rig: controlled state, drive, gains, noise, and range of the target."""

    state: str = Field(description="Controlled state; its rate is measured as well.")
    drive: str = Field(description="Parameter that is the amplitude of the drive, a cosine; control acts through it.")
    frequency_hz: float = Field(gt=0.0, description="Drive frequency [Hz].")
    start: float = Field(gt=0.0, description="First amplitude of the target.")
    stop: float = Field(gt=0.0, description="Last amplitude of the target.")
    num: int = Field(ge=2, le=10_000, description="Number of targets.")
    gain: float = Field(default=2.0, ge=0.0, description="Gain of the state.")
    gain_of_rate: float = Field(default=1.0, ge=0.0, description="Gain of its rate.")
    noise: float = Field(default=0.0, ge=0.0, description="Standard deviation of the measured state.")
    settle: int = Field(default=12, ge=1, description="Drive periods to settle after each change of the target.")
    measure: int = Field(default=8, ge=2, description="Drive periods that are then measured.")
    seed: int = Field(default=0, ge=0, description="Seed of the noise.")


def load_control(path: str | Path) -> tuple[Controlled, np.ndarray]:
    """Read a virtual rig with the table ``[control]``; return the settings and the target amplitudes.

    Raise `SpecError` with all problems at once.
    """
    path, problems = Path(path), []
    data = read_toml(path)
    known = ("model", "preset", "parameters", "control")
    problems += [unknown_key(key, key, known) for key in data if key not in known]
    parameters = rig_parameters(data, path.parent, problems)
    table = checked(ControlTable, data.get("control", {}), "control", problems)
    if problems or parameters is None or table is None:
        raise SpecError([f"{path}: {p}" for p in problems])
    gains, times = (table.gain, table.gain_of_rate), (table.settle, table.measure)
    rig = Controlled(
        parameters, table.frequency_hz, table.state, table.drive, gains, table.noise, *times, seed=table.seed
    )
    return rig, np.linspace(table.start, table.stop, table.num)


def orbits_csv(rig: Controlled, orbits: TracedOrbits) -> str:
    """Return traced orbits as the CSV table that ``magpend measured branch`` reads."""
    lines = [f"{rig.drive},amplitude,amplitude_sd,frequency,stable,name"]
    for k, word in enumerate(orbits.stable):
        numbers = orbits.drive[k], orbits.amplitude[k], orbits.amplitude_sd[k], rig.frequency_hz
        lines.append(f"{','.join(repr(float(v)) for v in numbers)},{word},target {k + 1}")
    return "\n".join(lines) + "\n"
