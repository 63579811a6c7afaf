"""Compute while the user watches: trajectories, slices of basins, orbits along a parameter, runs of regions."""
