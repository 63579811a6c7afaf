"""Integrate cells with white noise, go on with them, and estimate the error of their steps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from magpend_core import Sections, Status
from magpend_core.models.noisy import NoisyModel
from magpend_core.noisy import NoisySections, cell_words, noisy_sections
from pipeline.layout.cells import Inputs
from pipeline.specification.parsing import Spec

Values = dict[str, np.ndarray]


def under_noise(spec: Spec, inputs: Inputs) -> tuple[Sections, np.ndarray]:
    """Integrate the cells of a sweep with noise.

    Parameters
    ----------
    spec
        A specification with a table ``[noise]``.
    inputs
        Cells: branches of one point.

    Returns
    -------
    Sections
        With leading dims (branch, point).
    strong_error : ndarray, (branch, point)
        See `magpend_core.noisy.NoisySections`.
    """
    found = _integrated(spec, inputs, inputs.initial_states, n_keep=spec.integration.n_keep)
    steps = steps_of(spec, inputs)
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
    return Sections(**pointed), found.strong_error[:, None]


def steps_of(spec: Spec, inputs: Inputs) -> np.ndarray:
    """Return the number of steps per period of each cell."""
    assert spec.noise is not None
    return spec.noise.steps_at(inputs.frequency_hz[:, 0])


def _integrated(spec: Spec, inputs: Inputs, start: np.ndarray, *, n_keep: int, **options: Any) -> NoisySections:
    model = spec.model
    assert isinstance(model, NoisyModel)
    assert spec.noise is not None
    given: dict[str, Any] = {"n_transient": spec.integration.n_transient, **options}
    return noisy_sections(
        inputs.parameters[:, 0],
        inputs.frequency_hz[:, 0],
        start,
        system=model.system,
        noise=model.noise,
        seed=spec.noise.seed,
        steps_per_period=steps_of(spec, inputs),
        n_keep=n_keep,
        **given,
    )


def noisy_kept_on(
    spec: Spec, inputs: Inputs, stored: Mapping[str, np.ndarray], n_old: int
) -> tuple[np.ndarray, Values]:
    """Integrate stored noisy cells further; see `pipeline.compute.extension.kept_on`.

    A cell goes on with the noise of a longer run, since that depends on the cell's inputs and the step alone.
    """
    status = stored["status"][:, 0]
    go = np.flatnonzero(status == Status.BOUNDED)
    some = inputs.take(go)
    first = stored["n_periods"][go, 0]
    words = cell_words(some.parameters[:, 0], some.frequency_hz[:, 0], some.initial_states)
    more = _integrated(
        spec,
        some,
        stored["section"][go, 0, -1],
        n_keep=spec.integration.n_keep - n_old,
        n_transient=0,
        first_period=first,
        words=words,
    )
    values = {name: array.copy() for name, array in stored.items()}
    section = stored["section"]
    whole = np.full((*section.shape[:2], spec.integration.n_keep, section.shape[-1]), np.nan)
    whole[go, 0] = np.concatenate([section[go, 0], more.section], axis=1)
    values["section"] = whole
    if "turns" in values:
        values["turns"][go, 0] += more.turns_since_start
    values["n_periods"][go, 0] += more.n_periods
    values["n_steps"][go, 0] += (more.n_periods * steps_of(spec, some)).astype(values["n_steps"].dtype)
    values["strong_error"][go, 0] = more.strong_error
    is_exact = np.ones(len(status), bool)
    is_exact[go[more.status != Status.BOUNDED]] = False
    return is_exact, {name: array[is_exact] for name, array in values.items()}
