"""Find sensors whose zero drifts: residuals that rise or fall steadily over a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from pipeline.rig.identify.problem import DRIFT, Problem

Array = np.ndarray


@dataclass(frozen=True)
class Settings:
    """Numbers by which a drift is told from noise."""

    blocks: int = 16
    """Stretches of equal numbers of samples whose means are compared: of fewer a trend is chance more often, of more
    the noise of each mean is larger."""
    chance: float = 0.002
    """Largest probability of such a trend by chance (Kendall's tau)."""
    least: float = 0.5
    """Least drift over the recording, as a share of the rms of its residuals: a smaller one changes no estimate."""


def drift_warnings(problem: Problem, residuals: Sequence[Array], settings: Settings = Settings()) -> list[str]:
    """Return a sentence for each channel of a recording whose residuals drift and whose zero was not let to.

    Parameters
    ----------
    problem
        The fitted problem.
    residuals
        Of each of its pieces, shape (n, n_channels) [SI].
    settings
        Numbers by which a drift is told from noise.
    """
    found = []
    numbers = sorted({p.recording for p in problem.pieces})
    for number in numbers:
        own = [k for k, p in enumerate(problem.pieces) if p.recording == number]
        time = np.concatenate([problem.pieces[k].begin_s + problem.pieces[k].time for k in own])
        order = np.argsort(time, kind="stable")
        for c, name in enumerate(problem.channels):
            if any(f.name.startswith(f"zero.{name}.") and f.name.endswith(f".{DRIFT}") for f in problem.free):
                continue
            change = _change(time[order], np.concatenate([residuals[k][:, c] for k in own])[order], settings)
            if change:
                unit, where = problem.model.state(name).unit, f" of recording {number}" if len(numbers) > 1 else ""
                told = f"{change:+.3g}{'' if unit == '1' else f' {unit}'} over {np.ptp(time):.4g} s"
                found.append(
                    f"the residuals of {name}{where} drift by {told}: the sensor's zero may move. Fit it by "
                    f'sensors.zero = ["{name}"] and sensors.drift = ["{name}"].'
                )
    return found


def _change(time: Array, values: Array, settings: Settings) -> float:
    """Return by how much values drift from the first to the last sample; 0 if they do not."""
    known = np.isfinite(values)
    time, values = time[known], values[known]
    if len(values) < 2 * settings.blocks:
        return 0.0
    means = [part.mean() for part in np.array_split(values, settings.blocks)]
    change = float(np.polyfit(time, values, 1)[0] * np.ptp(time))
    rms = float(np.sqrt(np.mean(values**2)))
    is_steady = stats.kendalltau(np.arange(settings.blocks), means).pvalue < settings.chance
    return change if is_steady and abs(change) > settings.least * rms else 0.0
