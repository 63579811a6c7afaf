"""Compute one-dimensional stable and unstable manifolds of saddle orbits, and locate where they first touch.

Reading order: `growing` has the curves, `analysis` the analyses of a run and the first homoclinic tangency
along a parameter.
"""
