"""Analyse data of a test rig: recordings, magnet torque, parameter identification, measured bifurcation diagrams."""
