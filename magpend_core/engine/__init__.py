"""The engine: many trajectories in step, observed and linearised; knows no model."""
