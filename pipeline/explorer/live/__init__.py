"""Compute while the user watches: trajectories, basin slices, orbits that follow a parameter, runs of a region."""
