"""Spectra of motions: amplitudes of lines, and densities."""
