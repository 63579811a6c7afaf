"""The forced double pendulum with two repelling magnets: Wojna et al., J. Sound Vib. 430 (2018)."""

from magpend_core.models.pendulum.models import MODELS

__all__ = ["MODELS"]
