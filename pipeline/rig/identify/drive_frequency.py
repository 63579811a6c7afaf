"""Estimate how far the stated frequency of a known drive is off, after a fit that took it for exact.

One Gauss-Newton step from the fit, with a detuning of each known drive as a further unknown, gives an estimate with its
standard error (a score test: Rao, Math. Proc. Camb. Philos. Soc. 44, 1948, 50).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from pipeline.rig.identify.local import Fit
from pipeline.rig.identify.objective import evaluate
from pipeline.rig.identify.problem import DETUNING, Free, Problem
from pipeline.rig.identify.statistics import covariance_of, linearise, loss_scale_of

FAR = 2.0
"""Distance from the stated frequency, in half widths of the 95 % interval, that is reported: four standard errors or
more."""

VAGUE_PERIODS = 0.1
"""Half width of the interval, in drive periods over the recording, above which a step from the fit decides nothing."""

MISSED = 0.2
"""Root mean square of the residuals, relative to the spread of a channel, above which the fit misses so much of the
motion that a step from it decides nothing: several periods off, the cost hardly depends on the frequency."""

AGREES, OFF, OPEN = "agrees", "off", "not decided"


@dataclass(frozen=True)
class DriveFrequency:
    """Estimate of the frequency of a recording's known drive."""

    recording: int
    # frequency as stated and as estimated, and the standard error of the latter [Hz]
    frequency_hz: float
    estimate_hz: float
    error_hz: float
    verdict: str  # ``agrees``, ``off`` or ``not decided``

    def as_dict(self) -> dict[str, Any]:
        """Return the fields as plain data."""
        return asdict(self)

    @property
    def warning(self) -> str:
        """Sentence about a frequency that the data contradict or cannot judge; empty for one that they confirm."""
        where = f"recordings[{self.recording}].frequency_hz = {self.frequency_hz:.8g}"
        if self.verdict == OPEN:
            return (
                f"{where}: the fit cannot tell whether the drive has this frequency (standard error "
                f"{self.error_hz:.2g} Hz; the fit misses much of the motion, or the drive has little effect). A "
                "frequency that is far off looks like this: check it, and the recording's sampling rate."
            )
        if self.verdict == AGREES:
            return ""
        apart = abs(self.estimate_hz - self.frequency_hz) / self.error_hz
        return (
            f"{where}: the data contradict it, and all estimates suffer; they give about {self.estimate_hz:.8g} Hz, "
            f"{apart:.2g} standard errors ({self.error_hz:.2g} Hz) away. Correct it, or the recording's sampling rate, "
            "and identify again."
        )


def estimate_frequencies(problem: Problem, fit: Fit, scale: np.ndarray) -> list[DriveFrequency]:
    """Estimate the frequencies of the drives whose phases were fitted or stated, one step from the fit; `scale` are the
    unknowns' sizes.
    """
    stated = {p.recording: p.known_hz for p in problem.pieces if p.known_hz}
    if not stated:
        return []
    # a size turns the drive by one period from the start of a recording to its end
    sizes = [
        1.0 / max(p.begin_s + float(p.time[-1]) for p in problem.pieces if p.recording == recording)
        for recording in stated
    ]
    added = [Free(f"{DETUNING}.{r}", 0.0, unit="Hz", typical=s) for r, s in zip(stated, sizes, strict=True)]
    wider = replace(problem, free=(*problem.free, *added), slopes="differences", loss_scale=loss_scale_of(problem, fit))
    theta, scales = np.append(fit.theta, np.zeros(len(added))), np.append(scale, sizes)
    whole = evaluate(wider, theta[None], fit.starts[None], slopes=True)[0]
    there = replace(fit, theta=theta, rows=whole.rows, jacobian=whole.jacobian)
    linear = linearise(wider, there)
    # at the optimum the gradient by all other unknowns is 0
    gradient = (whole.jacobian.T @ whole.rows)[: len(theta)]
    gradient[: len(fit.theta)] = 0.0
    information = linear.information * np.outer(scales, scales)
    step = -scales * np.linalg.lstsq(information, scales * gradient, rcond=1e-12)[0]
    moved = tuple(r + s @ step for r, s in zip(linear.residuals, linear.slopes, strict=True))
    covariance = covariance_of(replace(linear, residuals=moved), scales)
    found = []
    for i, (recording, known) in enumerate(stated.items(), len(fit.theta)):
        moved_hz, error = float(step[i]), float(covariance.errors[i])
        half = covariance.critical * error
        vague = not half < VAGUE_PERIODS * scales[i] or _missed(problem, fit, recording) > MISSED
        verdict = OFF if abs(moved_hz) > FAR * half else OPEN if vague else AGREES
        found.append(DriveFrequency(recording, known, known + moved_hz, error, verdict))
    return found


def _missed(problem: Problem, fit: Fit, recording: int) -> float:
    """Return the residuals' largest root mean square of a channel in a recording, relative to the channel's spread."""
    own = [k for k, p in enumerate(problem.pieces) if p.recording == recording]
    left = np.nanmean(np.concatenate([fit.residuals[k] for k in own]) ** 2, axis=0)
    spread = np.nanvar(np.concatenate([problem.pieces[k].measured for k in own]), axis=0)
    return float(np.sqrt(np.max(left / np.maximum(spread, 1e-300))))
