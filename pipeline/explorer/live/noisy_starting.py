"""Integrate an initial state live with white noise on the model's rates, and send its section points.

A noisy trajectory settles on no attractor, so none is named at its end.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from magpend_core.disturbance import Disturbance
from magpend_core.models.model import Model
from magpend_core.models.noisy import NoisyModel, noisy
from magpend_core.noisy import NoisySections, cell_words, noisy_sections
from magpend_core.status import Status
from pipeline.explorer.live.jobs import Job
from pipeline.explorer.live.messages import RequestError, StartRequest
from pipeline.explorer.live.settling import Place
from pipeline.specification.noise import STEPS

if TYPE_CHECKING:
    from pipeline.explorer.live.live import LiveRun

PERIODS, PIECE = 400, 16
"""Periods of a noisy start, and those that are integrated and sent at once."""

TOLERANCE = 0.01
"""Largest change within a period when the steps are halved, in units of the scales; as that of a run's noise."""

MOST_STEPS = 64 * STEPS
"""Most steps per period that are tried."""


def noisy_states(model: Model) -> list[str]:
    """Return the names of the states whose equations get noise: the rates of other states, or all states."""
    rates = {state.rate for state in model.states if state.rate}
    return [name for name in model.state_names if name in rates or not rates]


def noisy_start(live: LiveRun, job: Job, place: Place, state: np.ndarray) -> None:
    """Integrate an initial state with the noise that a job asks for; send its section points piece by piece."""
    request = job.request
    assert isinstance(request, StartRequest)
    path = _NoisyPath(live, place, state, request.noise, request.seed)
    path.choose_steps(job)
    periods, found, error = request.periods or PERIODS, None, 0.0
    while path.done < periods and (found is None or found.status[0] == Status.BOUNDED):
        job.check()
        found = path.advance(min(PIECE, periods - path.done))
        error = max(error, float(np.nan_to_num(found.strong_error[0])))
        if error > TOLERANCE:
            raise RequestError(_too_long(path.steps))
        section = found.section[0][np.isfinite(found.section[0]).all(axis=1)]
        if len(section):
            job.show("sections", {"section": section}, periods_done=path.done)
    assert found is not None
    job.tell(
        "done",
        noise=request.noise,
        noisy_states=path.states,
        seed=request.seed,
        steps_per_period=path.steps,
        step_error=error,
        status=Status(int(found.status[0])).name.lower(),
        periods=path.done,
        label=None,
        colour=None,
        attractor=None,
        number=None,
        period=None,
        motion=None,
    )


def _too_long(steps: int) -> str:
    return (
        f"noise: {steps} steps in a period are too few for this motion; take a weaker noise, or make a run with "
        "[noise] and a shorter step."
    )


class _NoisyPath:
    """Trajectory with noise that is integrated a few periods at a time, with the bits of a cell of a noisy run.

    Attributes
    ----------
    states : list of str
        States whose equations have noise.
    steps : int
        Steps per period.
    done : int
        Periods integrated so far.
    """

    def __init__(self, live: LiveRun, place: Place, state: np.ndarray, strength: float, seed: int) -> None:
        model, self.states = live.model, noisy_states(live.model)
        if model.crossing is not None:
            raise RequestError("noise: sections of this run are crossings, and a noisy state crosses infinitely often.")
        # strengths are parameters: one compilation serves all of them
        self._model: NoisyModel = noisy(model, Disturbance(tuple((name, 1.0) for name in self.states)))
        own = [
            strength * scale for name, scale in zip(model.state_names, model.scales, strict=True) if name in self.states
        ]
        self._packed = np.concatenate([place.parameters.pack(), own, [0.0]])[None]
        self._frequency, self._seed = np.array([place.frequency]), seed
        self._state = np.array(state, np.float64)[None]
        self._words = cell_words(self._packed, self._frequency, self._state)
        self.steps, self.done = STEPS, 0

    def choose_steps(self, job: Job) -> None:
        """Double the steps until those of the first period are short enough; raise RequestError if none are."""
        while True:
            job.check()
            found = self._call(1)
            if not found.strong_error[0] > TOLERANCE:  # a start that diverges at once has no error
                return
            if self.steps >= MOST_STEPS:
                raise RequestError(_too_long(self.steps))
            self.steps *= 2

    def advance(self, n: int) -> NoisySections:
        """Integrate `n` periods further."""
        found = self._call(n)
        self._state, self.done = found.section[:, -1], self.done + int(found.n_periods[0])
        return found

    def _call(self, n: int) -> NoisySections:
        try:
            system, noise = self._model.system, self._model.noise
        except ValueError as error:  # impacts, or a drive that jumps
            raise RequestError(f"noise: {error}") from None
        return noisy_sections(
            self._packed,
            self._frequency,
            self._state,
            system=system,
            noise=noise,
            seed=self._seed,
            steps_per_period=self.steps,
            n_transient=0,
            n_keep=n,
            first_period=self.done,
            words=self._words,
        )
