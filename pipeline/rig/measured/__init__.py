"""Measure bifurcation diagrams on a rig from recorded sweeps, and compare them with computed ones."""
