"""Fit a law of the torque between magnets to measured curves, and write its parameters as a preset."""
