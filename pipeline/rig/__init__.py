"""Analyse data of a test rig: recordings, magnet torque, identification, measured bifurcation diagrams."""
