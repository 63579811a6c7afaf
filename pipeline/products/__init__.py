"""Declare what a run computes of its cells, and what analyses and figures compute from a cube."""
