"""Find which attractors trajectories reach after a parameter has moved, and at which rate that changes."""
