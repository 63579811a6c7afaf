"""Analyses of a cube: Dataset in, labelled data out. None integrates but `attractors.identify`.

It polishes one point per closed orbit and follows each attractor over a few periods for its features.
"""
