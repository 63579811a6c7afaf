"""Judge claims by comparing a measured interval with a claimed range."""

from __future__ import annotations

from enum import Enum


class Verdict(Enum):
    """Verdict on a claim: met, not met, undecided, or used for calibration.

    A claim on which parameters were calibrated tests nothing. It has its own verdict, whatever the result.
    """

    MET = "met"
    NOT_MET = "not met"
    UNDECIDED = "undecided"
    CALIBRATED = "calibrated on this, so no test"

    @property
    def words(self) -> str:
        """Verdict in words, for people."""
        return self.value

    @property
    def css(self) -> str:
        """CSS class of the block that shows this verdict on a page."""
        return self.name.lower().replace("_", "-")

    def __str__(self) -> str:
        return self.value


def judged(low: float, high: float, least: float, most: float) -> Verdict:
    """Judge a claim by comparing the confidence interval of a measured number with the claimed range.

    Parameters
    ----------
    low, high
        Confidence interval of the measured number; NaN if nothing was measured.
    least, most
        Claimed range; infinite on a side without a bound.

    Returns
    -------
    Verdict
        Met if the interval lies inside the claimed range, not met if it lies outside, otherwise undecided.
    """
    if not low <= high:  # NaN too
        return Verdict.UNDECIDED
    if low >= least and high <= most:
        return Verdict.MET
    if high < least or low > most:
        return Verdict.NOT_MET
    return Verdict.UNDECIDED
