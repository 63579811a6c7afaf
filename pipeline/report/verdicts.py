"""Verdicts on statements: what came out, with its interval, against what is claimed."""

from __future__ import annotations

from enum import Enum


class Verdict(Enum):
    """Whether a statement holds.

    A statement on which parameters were calibrated is no test of anything: it has a verdict of its own,
    whatever came out.
    """

    MET = "met"
    NOT_MET = "not met"
    UNDECIDED = "undecided"
    CALIBRATED = "calibrated on this, so no test"

    @property
    def words(self) -> str:
        """What people read."""
        return self.value

    @property
    def css(self) -> str:
        """Class of the block on a page."""
        return self.name.lower().replace("_", "-")

    def __str__(self) -> str:
        return self.value


def judged(low: float, high: float, least: float, most: float) -> Verdict:
    """Judge an interval against a claimed range.

    Parameters
    ----------
    low, high
        The interval in which the measured number lies with its confidence; NaN where nothing was measured.
    least, most
        What is claimed, infinite where it has no bound.

    Returns
    -------
    Verdict
        Met if the whole interval lies within the claim, not met if none of it does, otherwise undecided.
    """
    if not low <= high:  # NaN too
        return Verdict.UNDECIDED
    if low >= least and high <= most:
        return Verdict.MET
    if high < least or low > most:
        return Verdict.NOT_MET
    return Verdict.UNDECIDED
