"""Judge how well computed trajectories fit measured ones, by root mean squares and correlations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipeline.layout.writing import json_value
from pipeline.rig.identify.local import Fit, fit_local, fit_starts
from pipeline.rig.identify.problem import Piece, Problem
from pipeline.rig.identify.search import slowest_period


@dataclass(frozen=True)
class Judgement:
    """Residuals of measured pieces, with root mean squares and correlations."""

    channels: tuple[str, ...]
    pieces: tuple[Piece, ...]
    residuals: tuple[np.ndarray, ...]  # (n, n_channels) measured less computed [SI]; NaN where nothing was measured

    @property
    def rms(self) -> dict[str, float]:
        """Root mean square of each channel's residuals [SI]."""
        return self._rms(self.residuals)

    def rms_of(self, k: int) -> dict[str, float]:
        """Return the root mean square of each channel's residuals in piece `k` [SI]."""
        return self._rms([self.residuals[k]])

    def _rms(self, residuals: Sequence[np.ndarray]) -> dict[str, float]:
        if not residuals:
            return {}
        stacked = np.concatenate(residuals)
        count = np.isfinite(stacked).sum(axis=0)
        with np.errstate(invalid="ignore"):
            mean = np.nansum(stacked**2, axis=0) / count
        return dict(zip(self.channels, np.sqrt(mean).tolist(), strict=True))

    @property
    def correlation(self) -> dict[str, float]:
        """Pearson's correlation coefficient between measured and computed values, by channel."""
        if not self.pieces:
            return {}
        measured = np.concatenate([p.measured for p in self.pieces])
        computed = measured - np.concatenate(self.residuals)
        return {name: _pearson(measured[:, c], computed[:, c]) for c, name in enumerate(self.channels)}

    def as_dict(self) -> dict[str, Any]:
        """Return rms and correlation by channel, and the rms of each piece, as plain data; None is undefined."""
        return {
            "rms": json_value(self.rms),
            "correlation": json_value(self.correlation),
            "pieces": [
                {"recording": p.recording, "piece": p.number, "rms": json_value(self.rms_of(k))}
                for k, p in enumerate(self.pieces)
            ],
        }


def _pearson(x: np.ndarray, y: np.ndarray) -> float:
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        return float("nan")
    x, y = x[known] - x[known].mean(), y[known] - y[known].mean()
    size = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y / size) if size > 0 else float("nan")


def judge_fit(problem: Problem, fit: Fit) -> Judgement:
    """Return the residuals of a fit on the pieces that it was fitted to."""
    return Judgement(problem.channels, problem.pieces, fit.residuals)


def known_problem(
    problem: Problem, values: Mapping[str, float], zeros: Mapping[str, float], pieces: Sequence[Piece]
) -> Problem:
    """Return a least-squares problem in which only the initial states of the given pieces are unknown.

    `values` are all parameters by name [SI], `zeros` the sensors' zeros by the names of their unknowns [SI].
    """
    free = tuple(f for f in problem.free if f.name in zeros)
    known = replace(
        problem,
        fixed=problem.fixed.replace(**values),
        free=free,
        tied={},
        pieces=tuple(pieces),
        loss="linear",
        continuity=None,
    )
    return known.without(zeros)


def judge(
    problem: Problem, values: Mapping[str, float], zeros: Mapping[str, float], pieces: Sequence[Piece]
) -> tuple[Judgement, Fit]:
    """Judge known parameters on pieces that they were not fitted to; only the initial states of these pieces are
    fitted.

    Return the judgement and the fit of the starts, which may not have converged.
    """
    # length, in periods of the slowest oscillation, over which starts are fitted first. The length is then doubled
    # until it covers the piece: a long piece does not tolerate a bad guess.
    n_periods = 0.7
    known = known_problem(problem, values, zeros, pieces)
    longest = max(float(p.time[-1]) for p in known.pieces)
    length, starts = n_periods * slowest_period(known), known.starts
    while length < longest:
        starts = fit_starts(_beginning(known, length), np.zeros(0), starts).starts
        length *= 2
    fit = fit_local(known, np.zeros(0), starts=starts)
    return Judgement(problem.channels, tuple(pieces), fit.residuals), fit


def _beginning(problem: Problem, length_s: float) -> Problem:
    fewest = 4 * len(problem.model.states)
    pieces = []
    for p in problem.pieces:
        n = min(len(p.time), max(fewest, int(np.searchsorted(p.time, length_s))))
        pieces.append(replace(p, time=p.time[:n], measured=p.measured[:n]))
    return replace(problem, pieces=tuple(pieces))
