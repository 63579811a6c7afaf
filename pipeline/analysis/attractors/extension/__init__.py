"""Integrate trajectories further whose attractor is not known yet, and describe the sets on which they stay."""
