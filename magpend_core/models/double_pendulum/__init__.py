"""Define the planar double pendulum: its description in `models`, its equations in `system`."""

from magpend_core.models.double_pendulum.models import MODELS

__all__ = ["MODELS"]
