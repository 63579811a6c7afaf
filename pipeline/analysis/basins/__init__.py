"""Basins of attraction: fractions, boundaries, Wada property."""
