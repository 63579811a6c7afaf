"""Frequency responses: amplitudes, phases and harmonics along branches of periodic orbits."""
