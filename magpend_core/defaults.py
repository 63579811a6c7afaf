"""Define the default tolerances and limits of all integrations."""

from __future__ import annotations

RTOL = 1e-8
"""Relative tolerance of a step."""

ATOL = 1e-8
"""Absolute tolerance of a step, in the states' units."""

MOST_STEPS = 20_000
"""Most attempted steps per period: a period of the pendulum takes about 140 at a tolerance of 1e-8."""

MOST_STEPS_BETWEEN = 1_000_000
"""Most attempted steps per interval of a drive or between two asked instants, which may be many periods apart."""

CLOSURE = 1e-6
"""Scaled distance to a closed orbit below which a cell counts as closed: a hundred tolerances."""

LONGEST_PERIOD = 16
"""Longest orbit period that is detected [drive periods or returns]."""

DRIVE_HZ = 2.2
"""Drive frequency of a single trajectory, if none is given [Hz]."""
