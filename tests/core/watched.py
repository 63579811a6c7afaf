"""Quantities that tests watch: an engine is compiled for each choice of them."""

OF_THE_DRIVE = ("drive_torque", "psi1")

# the last has peaks of the Stribeck effect that are hardly wider than a step
OF_THE_MOTION = ("energy", "power_in", "power_dissipated", "load2", "magnet_moment", "magnet_x", "friction1")

OF_THE_PENDULUM = OF_THE_DRIVE + OF_THE_MOTION
