"""Show the explorer's page as a widget of a notebook, whose kernel answers the page's requests."""

LEAST_HEIGHT = 320
"""Lowest widget in which the diagram has its axes [CSS px]."""
