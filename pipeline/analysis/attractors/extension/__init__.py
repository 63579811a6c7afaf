"""Integrate trajectories without a known attractor further, and describe the sets on which they stay."""
