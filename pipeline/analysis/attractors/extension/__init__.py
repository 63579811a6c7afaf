"""Extend the integration of trajectories without a known attractor, and describe the sets on which they stay."""
