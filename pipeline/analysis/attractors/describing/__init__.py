"""Assign the trajectories of a parameter point to attractors, and compute the features of the attractors."""
