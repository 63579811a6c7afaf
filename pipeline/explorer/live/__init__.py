"""Compute while the user watches: starts, slices of basins, orbits that follow a parameter, runs of a region."""
