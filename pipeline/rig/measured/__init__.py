"""Measure bifurcation diagrams and branches of orbits on a rig, and compare them with computed ones."""
