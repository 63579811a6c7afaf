"""Measured branches of periodic orbits, stable and unstable, beside computed ones."""
