"""Measure how attractors respond to disturbances: arrival times, critical shocks, edge states."""
