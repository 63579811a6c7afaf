"""Planar double pendulum: what it is in `models`, its equations in `system`."""

from magpend_core.models.double_pendulum.models import MODELS

__all__ = ["MODELS"]
