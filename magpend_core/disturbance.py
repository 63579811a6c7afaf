"""Define white noise on a model's equations: strengths by state, and their interpretation."""

from __future__ import annotations

from dataclasses import dataclass

INTERPRETATIONS = ("ito", "stratonovich")


@dataclass(frozen=True)
class Disturbance:
    """White noise on equations of a model: strengths by state, and their interpretation.

    Attributes
    ----------
    strengths : tuple of (str, float or str)
        State, and a number or an expression of states and parameters. The noise's unit is that of the state
        over the square root of a second.
    interpretation : str
        ``"ito"`` or ``"stratonovich"``; empty where no strength depends on a noisy state.
    """

    strengths: tuple[tuple[str, float | str], ...]
    interpretation: str = ""

    @property
    def expressions(self) -> dict[str, str]:
        """Strengths that are expressions, by state."""
        return {name: value for name, value in self.strengths if isinstance(value, str)}
