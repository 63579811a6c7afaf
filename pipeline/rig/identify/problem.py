"""Define the least-squares problem: unknowns, pieces of recordings, and model parameters as functions of the
unknowns.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from magpend_core.defaults import RTOL
from magpend_core.engine.system import System
from magpend_core.models.model import Model, Parameters
from magpend_core.sampling import Drive, with_recorded_drive
from pipeline.analysis.branches.carrying import OrbitData, Solution

ZERO = "zero"
"""Prefix of the names of sensors' zeros: ``zero.CHANNEL`` or ``zero.CHANNEL.RECORDING``."""

DRIFT = "drift"
"""End of the name of the rate at which a sensor's zero moves: ``zero.CHANNEL.drift``."""

PHASE, DETUNING = "phase", "detuning"
"""Prefixes of the names of a known drive's unknowns: ``phase.RECORDING`` at the recording's time 0 [drive periods], and
``detuning.RECORDING``, its frequency less the stated one [Hz]."""


def steady_drive(
    frequency_hz: float, phase: float, length_s: float, names: tuple[str, ...] = (), values: np.ndarray | None = None
) -> Drive:
    """Return a drive of one frequency for twice a length, from a phase [drive periods] on; `values` hold throughout."""
    period = 1.0 / frequency_hz
    n = math.ceil(2.0 * length_s * frequency_hz) + 1
    row = np.zeros(0) if values is None else values
    start = min(phase % 1.0 * period, math.nextafter(period, 0.0))
    return Drive(np.full(n, period), names, np.tile(row, (n, 1)), start)


@dataclass(frozen=True)
class Free:
    """Unknown of the fit: a parameter of the model, the zero offset of a sensor, or the phase of a known drive."""

    # name of the parameter; ``zero.CHANNEL`` for all recordings, ``zero.CHANNEL.RECORDING`` for one, and with
    # ``.drift`` after it the rate at which this zero moves; ``phase.RECORDING``
    name: str
    # first guess and bounds [SI]
    start: float
    lower: float = -math.inf
    upper: float = math.inf
    unit: str = ""
    meaning: str = ""
    # mean and standard deviation of an independent measurement; NaN for none
    prior_mean: float = math.nan
    prior_sd: float = math.nan
    typical: float = math.nan  # typical size, for an unknown whose start and bounds do not tell it; NaN: they do

    @property
    def size(self) -> float:
        """Typical size of the unknown. Steps of finite differences and of the search are fractions of this size."""
        if math.isfinite(self.typical):
            return self.typical
        width = self.upper - self.lower
        least = 1e-2 * width if math.isfinite(width) else 0.0
        return max(abs(self.start), least) or 1.0

    @property
    def has_prior(self) -> bool:
        """Whether the unknown has a prior from an independent measurement."""
        return math.isfinite(self.prior_sd)


@dataclass(frozen=True)
class Piece:
    """Stretch of a recording that is fitted as one trajectory with its own unknown initial state."""

    # index of the recording, and of the piece in it
    recording: int
    number: int
    time: np.ndarray  # (n,) time since the stretch's start, rising from 0 [s]
    measured: np.ndarray  # (n, n_channels) measured values [SI]; NaN where nothing was measured
    start: np.ndarray  # (n_states,) first guess of the state at time 0 [SI]
    drive: Drive | None = None
    follows: int = -1  # index in the problem of the stretch that this one continues; -1 for none
    begin_s: float = 0.0  # time of the stretch's start by the recording's clock [s]
    known_hz: float = 0.0  # frequency of a drive that was not measured; 0 for any other [Hz]

    def turned(self, phase: float, detuning_hz: float) -> Piece:
        """Return the piece with its known drive moved by a phase at the recording's time 0, and detuned."""
        if self.drive is None or not self.known_hz or (phase == 0.0 and detuning_hz == 0.0):
            return self
        begun = self.drive.start_s * self.known_hz + phase + detuning_hz * self.begin_s
        values = self.drive.values[0] if self.drive.names else None
        drive = steady_drive(self.known_hz + detuning_hz, begun, float(self.time[-1]), self.drive.names, values)
        return replace(self, drive=drive)


@dataclass(frozen=True)
class Problem:
    """Least-squares problem: the unknowns are parameters, sensor offsets and the pieces' initial states."""

    model: Model
    fixed: Parameters  # values of the parameters that are not identified
    free: tuple[Free, ...]
    channels: tuple[str, ...]
    pieces: tuple[Piece, ...]
    noise: np.ndarray  # (n_channels,) standard deviations that residuals are divided by [SI]
    # by parameter, the factor and the name of the parameter that it follows
    tied: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    loss: str = "linear"  # ``linear``, ``soft_l1``, ``huber`` or ``cauchy``, as in `scipy.optimize.least_squares`
    loss_scale: float = 1.0  # residual, in units of the noise, above which a robust loss grows slower than the square
    # weight of the gap between a stretch's end and the next one's start; None leaves the starts free
    continuity: float | None = None
    rtol: float = RTOL  # tolerance of the integration, relative and absolute
    slopes: str = "differences"  # method for slopes: ``differences`` between lanes or ``variational`` equations
    recorded: bool = False  # whether the pieces' drives are measured torques instead of the model's own drive
    orbits: tuple[OrbitData, ...] = ()  # measured orbits and bifurcations that are fitted
    held: bool = False  # whether slopes are computed by the starts alone, as the unknowns are held

    @cached_property
    def system(self) -> System:
        """System that is integrated; a torque that the recordings contain is its drive."""
        return with_recorded_drive(self.model.system) if self.recorded else self.model.system

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(f.name for f in self.free)

    @cached_property
    def start(self) -> np.ndarray:
        """First guess of the unknowns."""
        return np.array([f.start for f in self.free])

    @cached_property
    def lower(self) -> np.ndarray:
        """Lower bounds of the unknowns."""
        return np.array([f.lower for f in self.free])

    @cached_property
    def upper(self) -> np.ndarray:
        """Upper bounds of the unknowns."""
        return np.array([f.upper for f in self.free])

    @cached_property
    def starts(self) -> np.ndarray:
        """First guesses of the initial states of the pieces, (n_piece, n_states)."""
        return np.array([p.start for p in self.pieces]).reshape(-1, len(self.model.states))

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Index of the state that each channel measures."""
        return tuple(self.model.state_names.index(name) for name in self.channels)

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Indices of the unknowns that are parameters of the model."""
        return tuple(i for i, f in enumerate(self.free) if "." not in f.name)

    @property
    def sloped(self) -> tuple[int, ...]:
        """Indices of the unknowns by which the trajectories' slopes are computed: all but zeros, or none if `held`."""
        return () if self.held else tuple(i for i, f in enumerate(self.free) if not f.name.startswith(f"{ZERO}."))

    @cached_property
    def phases(self) -> dict[int, int]:
        """Index of the unknown phase of a drive, for each recording that has one."""
        return {int(f.name.split(".")[1]): i for i, f in enumerate(self.free) if f.name.startswith(f"{PHASE}.")}

    @cached_property
    def turns(self) -> np.ndarray:
        """Derivatives of each known drive's phase and detuning by the unknowns, shape (recording, 2, n_free)."""
        found = np.zeros((self._n_recordings, 2, len(self.free)))
        for i, f in enumerate(self.free):
            word, *rest = f.name.split(".")
            if word in (PHASE, DETUNING) and rest:
                found[int(rest[0]), int(word == DETUNING), i] = 1.0
        return found

    @property
    def _n_recordings(self) -> int:
        """Number of recordings that have a piece, or an unknown of their own."""
        named = [int(last) for f in self.free if (last := f.name.rpartition(".")[2]).isdigit()]
        return 1 + max([*named, *(p.recording for p in self.pieces)], default=0)

    @cached_property
    def _zeros(self) -> np.ndarray:
        """Derivatives of each channel's offset at time 0, and of its rate, by the unknowns (0 or 1), shape
        (2, recording, n_channels, n_free).
        """
        found = np.zeros((2, self._n_recordings, len(self.channels), len(self.free)))
        for i, f in enumerate(self.free):
            word, *rest = f.name.split(".")
            if word == ZERO:
                moves = rest[-1] == DRIFT and len(rest) > 1
                which = int(rest[1]) if len(rest) > 1 + moves else slice(None)
                found[int(moves), which, self.channels.index(rest[0]), i] = 1.0
        return found

    def offsets(self, piece: Piece) -> np.ndarray:
        """Return the derivatives of the channels' offsets by the unknowns at the samples of a piece.

        Shape (n, n_channels, n_free), with n = 1 if no zero drifts.
        """
        constant, rate = self._zeros[:, piece.recording]
        if not rate.any():
            return np.asarray(constant[None])
        return np.asarray(constant + (piece.begin_s + piece.time)[:, None, None] * rate)

    @cached_property
    def state_noise(self) -> np.ndarray:
        """Scale of each state, (n_states,). The gaps between the end of one piece and the start of the next are divided
        by it.

        Channels have their noise. The values of other states are proportional to their spread over the
        starts.
        """
        spread = self.starts.std(axis=0) + 1e-12 * np.array(self.model.scales)
        reference = float(np.mean(self.noise / spread[list(self.columns)]))
        noise = reference * spread
        noise[list(self.columns)] = self.noise
        return np.asarray(noise)

    def values(self, theta: np.ndarray) -> dict[str, float]:
        """Return the value of every model parameter by name, for given unknowns of the fit."""
        found = self.fixed.as_dict()
        found |= {self.free[i].name: float(theta[i]) for i in self.moving}
        for name, (factor, other) in self.tied.items():
            found[name] = factor * found[other]
        return found

    def pack(self, thetas: np.ndarray) -> np.ndarray:
        """Return the model's packed parameters for each row of unknowns of the fit, shape (n, n_parameters).

        With unknowns of known drives, phase and detuning of each recording follow.
        """
        names = list(self.fixed.names)
        packed = np.tile(self.fixed.pack(), (len(thetas), 1))
        for i in self.moving:
            packed[:, names.index(self.free[i].name)] = thetas[:, i]
        for name, (factor, other) in self.tied.items():
            packed[:, names.index(name)] = factor * packed[:, names.index(other)]
        more = len(self.system.parameter_names) - len(names)
        turns = self.turns.reshape(-1, len(self.free)) if self.turns.any() else np.zeros((0, len(self.free)))
        return np.hstack([packed, np.zeros((len(thetas), more)), thetas @ turns.T])

    def with_orbits(self, known: Sequence[Solution]) -> Problem:
        """Return the problem with new computed orbits to start Newton's method, one `Solution` per table."""
        orbits = tuple(replace(table, known=own) for table, own in zip(self.orbits, known, strict=True))
        return replace(self, orbits=orbits)

    def without(self, fixed: Mapping[str, float]) -> Problem:
        """Return the least-squares problem with some unknowns fixed at given values.

        A sensor's zero that is held is subtracted from the measured values; a phase moves the drives.
        """
        held = {name: value for name, value in fixed.items() if "." not in name}
        kept = tuple(f for f in self.free if f.name not in fixed)
        offset = np.array([fixed.get(f.name, 0.0) for f in self.free]) * [
            f.name not in held and f.name in fixed for f in self.free
        ]
        pieces = tuple(
            replace(p, measured=p.measured - self.offsets(p) @ offset).turned(*self.turns[p.recording] @ offset)
            for p in self.pieces
        )
        return replace(self, fixed=self.fixed.replace(**held), free=kept, pieces=pieces)
