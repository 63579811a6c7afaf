"""Define what the integration of cells begins with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from magpend_core.models.model import Model
from magpend_core.status import Status
from pipeline.specification.tables import Integration

if TYPE_CHECKING:
    from magpend_core.engine.system import System
    from magpend_core.sections import Sections


@dataclass(frozen=True)
class Inputs:
    """Input arrays of `run_branches` for one task: parameters, frequencies and initial states of its branches."""

    parameters: np.ndarray  # shape (branch, point, parameter)
    frequency_hz: np.ndarray  # shape (branch, point)
    initial_states: np.ndarray  # shape (branch, n_states)
    # first step of each branch that continues an earlier task [s]; NaN for a branch that has ended. None for a task
    # in which all branches begin, shape (branch,)
    step_size: np.ndarray | None = None

    def take(self, branches: Any) -> Inputs:
        """Return the inputs of selected branches."""
        step = None if self.step_size is None else self.step_size[branches]
        return Inputs(self.parameters[branches], self.frequency_hz[branches], self.initial_states[branches], step)


Values = dict[str, np.ndarray]

SETTINGS = ("n_transient", "n_keep", "rtol", "atol", "max_steps_per_period", "closure_tolerance", "max_orbit_period")
"""Keys of ``[integration]`` that every integrator without noise takes."""

SUMS = ("turns", "n_periods", "n_steps", "n_rejected")
"""Variables to which the extension of a cell is added."""

PER_SECTION = ("section", "extremes")
"""Variables with an entry for each kept section, NaN in cells that failed."""

MICROSECONDS_PER_PERIOD, MICROSECONDS_PER_SECOND = 9.0, 21.5
"""Rule of thumb for one trajectory on one core at rtol 1e-8: a period of length T takes
9 us + 21.5 us T/s (measured between 0.1 and 3 Hz on AVX-512, good to 20 %).
"""

MICROSECONDS_PER_ITERATION = 0.1
"""Rule of thumb for one iteration of a map on one core."""

RTOL_OF_RULE = 1e-8
ROOT = 6
"""The time is proportional to (1/rtol)^(1/6)."""


@dataclass(frozen=True)
class Steady:
    """Motion at constant parameters without noise: a state goes on in the same way whenever it is reached."""

    model: Model  # model that is integrated
    integration: Integration  # the table ``[integration]``

    kind: ClassVar[str] = "steady"
    """The kind of motion that an `Analysis` is for."""

    has_quantities: ClassVar[bool] = True
    """Whether the model's quantities follow from a section point."""

    @property
    def frequency_meaning(self) -> str:
        """Meaning of the frequency that a specification gives or sweeps."""
        return self.model.clock.frequency

    @property
    def obstacle(self) -> str:
        """Clause that says what keeps a state from going on in the same way for ever; empty if nothing does."""
        return ""

    @property
    def needed(self) -> str:
        """The run to make instead, in which a state goes on in the same way."""
        return ""

    def refusal(self, what: str) -> str:
        """Return the sentence that refuses what integrates a cell's states in the same way for ever, such as an orbit;
        empty if the motion allows it.
        """
        return self.obstacle and f"{self.obstacle}; {what} needs {self.needed}."

    def seconds_per_period(self, frequency_hz: np.ndarray) -> np.ndarray:
        """Estimate the computing time per drive period of one trajectory on one core [s], by a rule of thumb."""
        if not self.model.clock.is_continuous:
            return np.full(np.shape(frequency_hz), MICROSECONDS_PER_ITERATION * 1e-6)
        microseconds = MICROSECONDS_PER_PERIOD + MICROSECONDS_PER_SECOND / np.asarray(frequency_hz)
        return np.asarray(microseconds * 1e-6 * (RTOL_OF_RULE / self.integration.rtol) ** (1 / ROOT))

    @property
    def system(self) -> System:
        """System that is integrated, with the method of the run."""
        return replace(self.model.system.plain, method=self.integration.method)

    @property
    def settings(self) -> dict[str, Any]:
        """Keywords of the integrators without noise."""
        return {name: getattr(self.integration, name) for name in SETTINGS}

    def integrate(self, inputs: Inputs, quantities: Sequence[str] | None) -> tuple[Sections, Values]:
        """Integrate branches point by point. Branches that failed in the preceding task get the status UNREACHED.

        Parameters
        ----------
        inputs
            The branches.
        quantities
            Names of the quantities to watch.

        Returns
        -------
        Sections
            With leading dims (branch, point).
        own : dict
            Further variables of the kind of motion, with the same dims.
        """
        from magpend_core.sections import Sections, run_branches

        alive = np.ones(len(inputs.initial_states), bool) if inputs.step_size is None else np.isfinite(inputs.step_size)
        some = inputs.take(alive)
        cells = run_branches(
            some.parameters,
            some.frequency_hz,
            some.initial_states,
            **self.settings,
            stop_when_closed=self.integration.stop_when_closed,
            step_size=some.step_size,
            system=self.system,
            quantities=quantities,
        )
        if alive.all():
            return cells, {}
        found: dict[str, Any] = {f.name: getattr(cells, f.name) for f in fields(cells)}
        return Sections(**{name: _spread(name, array, alive) for name, array in found.items()}), {}

    def no_extension(self) -> str:
        """Return the reason why cells with fewer sections cannot be integrated further; empty if they can."""
        if self.integration.stop_when_closed or self.integration.n_keep >= self._judged:
            return ""
        return f"what closes is judged by the last {self._judged} sections: keep as many"

    @property
    def _judged(self) -> int:
        """Number of last section points from which a run decides whether an orbit has closed."""
        from magpend_core.engine.observers import window_of

        n_periods = self.integration.n_transient + self.integration.n_keep
        return min(n_periods, window_of(self.integration.max_orbit_period))

    def extend(
        self, inputs: Inputs, stored: Mapping[str, np.ndarray], n_old: int, quantities: Sequence[str] | None
    ) -> tuple[np.ndarray, Values]:
        """Integrate cells of an earlier run further, until they have as many section points as the new run keeps.

        A cell is left out if its outcome could differ from that of a longer run: if the moment at which its orbit
        closed is not known, or if it fails later.

        Parameters
        ----------
        inputs, quantities
            As for `integrate`, with branches of one point.
        stored
            Variables of the cells, with leading dims (branch, point).
        n_old
            Number of sections that the cells have.

        Returns
        -------
        is_exact : ndarray of bool, (branch,)
            Mask of the cells that have the values of a longer run.
        values : dict
            Variables of these cells.
        """
        from magpend_core.extension import orbit_periods

        integration, judged = self.integration, self._judged
        was_kept = np.isin(stored["status"][:, 0], (Status.PERIODIC, Status.BOUNDED))
        closed = was_kept & (stored["n_periods"][:, 0] < integration.n_transient + n_old)
        is_exact = ~was_kept | closed
        if integration.n_keep >= judged:
            # where a run stops at closed orbits, one of these may have closed in the very last period before
            unsure = integration.stop_when_closed & (stored["status"][:, 0] == Status.PERIODIC)
            is_exact |= ~unsure
        go = np.flatnonzero(was_kept & is_exact)
        last, step_size = stored["section"][go, 0, -1], stored["step_size"][go, 0]
        more = self._more(inputs.take(go), last, step_size, integration.n_keep - n_old, quantities)
        failed = go[more["status"][:, 0] != Status.BOUNDED]
        values = {name: _longer(name, array, more, go, integration.n_keep) for name, array in stored.items()}
        open_ = np.flatnonzero(was_kept & is_exact & ~closed)
        periods = np.zeros(0, np.int16)
        if len(open_):
            periods = orbit_periods(
                values["section"][open_, 0, -judged:],
                system=self.system,
                closure_tolerance=integration.closure_tolerance,
                max_orbit_period=integration.max_orbit_period,
            )
        values["orbit_period"][open_, 0] = periods
        values["status"][open_, 0] = np.where(periods > 0, Status.PERIODIC, Status.BOUNDED)
        is_exact[failed] = False
        return is_exact, {name: array[is_exact] for name, array in values.items()}

    def _more(
        self, inputs: Inputs, last: np.ndarray, step_size: np.ndarray, n_more: int, quantities: Sequence[str] | None
    ) -> Values:
        """Integrate cells on from their stored last states; return what the further periods give."""
        from magpend_core.extension import more_sections

        cells = more_sections(
            inputs.parameters,
            inputs.frequency_hz,
            last,
            step_size,
            n_more=n_more,
            rtol=self.integration.rtol,
            atol=self.integration.atol,
            max_steps_per_period=self.integration.max_steps_per_period,
            system=self.system,
            quantities=quantities,
        )
        names = ("status", "step_size", *SUMS, *PER_SECTION)
        return {name: np.asarray(getattr(cells, name)) for name in names if getattr(cells, name) is not None}


def _spread(name: str, found: Any, alive: np.ndarray) -> Any:
    """Copy results of the integrated branches into arrays of all branches, with fill values for the other branches."""
    if found is None:
        return None
    fill = int(Status.UNREACHED) if name == "status" else np.nan if found.dtype.kind == "f" else 0
    whole = np.full((len(alive), *found.shape[1:]), fill, found.dtype)
    whole[alive] = found
    return whole


def _longer(name: str, old: np.ndarray, more: Mapping[str, np.ndarray], go: np.ndarray, n: int) -> np.ndarray:
    if name in PER_SECTION:
        whole = np.full((*old.shape[:2], n, *old.shape[3:]), np.nan)
        whole[go] = np.concatenate([old[go], more[name]], axis=2)
        return whole
    new = old.copy()
    if name in SUMS:
        new[go] += more[name]
    elif name == "step_size":
        new[go] = more[name]
    return new
