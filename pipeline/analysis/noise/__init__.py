"""Analyse runs with noise: escapes from a set, and densities of section points."""
