"""Integrate cells with white noise, and go on with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from magpend_core.models.noisy import NoisyModel
from magpend_core.status import Status
from pipeline.motion.steady import Inputs, Steady, Values
from pipeline.specification.noise import NoiseTable

if TYPE_CHECKING:
    from magpend_core.noisy import NoisySections
    from magpend_core.sections import Sections

MICROSECONDS_PER_STEP = 0.25
"""Time of a step of one trajectory, a rule for the paper's pendulum."""


@dataclass(frozen=True)
class Noisy(Steady):
    """Motion with white noise on equations of the model."""

    table: NoiseTable

    kind: ClassVar[str] = "noisy"

    @property
    def obstacle(self) -> str:
        return "its cells have noise"

    @property
    def needed(self) -> str:
        return "a run without [noise]"

    def seconds_per_period(self, frequency_hz: np.ndarray) -> np.ndarray:
        return self.table.steps_at(np.asarray(frequency_hz)) * MICROSECONDS_PER_STEP * 1e-6

    @property
    def path(self) -> dict[str, Any]:
        """Keywords of the core that decide the noise of a cell, but for its steps."""
        assert isinstance(self.model, NoisyModel)
        return {"system": self.model.system, "noise": self.model.noise, "seed": self.table.seed}

    def steps(self, inputs: Inputs) -> np.ndarray:
        """Return the number of steps per period of each cell."""
        return self.table.steps_at(inputs.frequency_hz[:, 0])

    def integrate(self, inputs: Inputs, quantities: Sequence[str] | None) -> tuple[Sections, Values]:
        from magpend_core.sections import Sections

        integration, steps = self.integration, self.steps(inputs)
        given: dict[str, Any] = {"n_transient": integration.n_transient, "n_keep": integration.n_keep}
        found = self._sections(inputs, inputs.initial_states, **given)
        is_kept = found.status == Status.BOUNDED
        cells = Sections(
            section=found.section,
            turns=found.turns,
            status=found.status,
            orbit_period=np.zeros(len(steps), np.int16),
            n_periods=found.n_periods,
            n_steps=(found.n_periods * steps).astype(np.int32),
            n_rejected=np.zeros(len(steps), np.int32),
            final_state=found.section[:, -1],
            step_size=np.where(is_kept, 1.0 / inputs.frequency_hz[:, 0] / steps, np.nan),
        )
        pointed = {name: value[:, None] for name, value in vars(cells).items() if value is not None}
        return Sections(**pointed), {"strong_error": found.strong_error[:, None]}

    def _sections(self, inputs: Inputs, starts: np.ndarray, **options: Any) -> NoisySections:
        from magpend_core.noisy import noisy_sections

        return noisy_sections(
            inputs.parameters[:, 0],
            inputs.frequency_hz[:, 0],
            starts,
            **self.path,
            steps_per_period=self.steps(inputs),
            **options,
        )

    def no_extension(self) -> str:
        return ""

    def extend(
        self, inputs: Inputs, stored: Mapping[str, np.ndarray], n_old: int, quantities: Sequence[str] | None
    ) -> tuple[np.ndarray, Values]:
        """Integrate stored cells further; see `Steady.extend`.

        A cell goes on with the noise of a longer run, since that depends on the cell's inputs and the step alone.
        """
        from magpend_core.noisy import cell_words

        n_keep = self.integration.n_keep
        status = stored["status"][:, 0]
        go = np.flatnonzero(status == Status.BOUNDED)
        some = inputs.take(go)
        more = self._sections(
            some,
            stored["section"][go, 0, -1],
            n_transient=0,
            n_keep=n_keep - n_old,
            first_period=stored["n_periods"][go, 0],
            words=cell_words(some.parameters[:, 0], some.frequency_hz[:, 0], some.initial_states),
        )
        values = {name: array.copy() for name, array in stored.items()}
        section = stored["section"]
        whole = np.full((*section.shape[:2], n_keep, section.shape[-1]), np.nan)
        whole[go, 0] = np.concatenate([section[go, 0], more.section], axis=1)
        values["section"] = whole
        if "turns" in values:
            values["turns"][go, 0] += more.turns_since_start
        values["n_periods"][go, 0] += more.n_periods
        values["n_steps"][go, 0] += (more.n_periods * self.steps(some)).astype(values["n_steps"].dtype)
        values["strong_error"][go, 0] = more.strong_error
        is_exact = np.ones(len(status), bool)
        is_exact[go[more.status != Status.BOUNDED]] = False
        return is_exact, {name: array[is_exact] for name, array in values.items()}
