"""Coexisting attractors: found, described, followed along the axes."""
