"""Define the forced Duffing oscillator."""

from magpend_core.models.duffing.models import MODELS

__all__ = ["MODELS"]
