"""The magnet torque: measured curves, their fit, a preset of it."""
