"""Fit the magnet torque to measured curves, and write a preset."""
