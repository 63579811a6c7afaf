"""The numerical engine: integrates many trajectories of any system at a time, with observers and tangent vectors."""
