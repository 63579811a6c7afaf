"""Analyse basins of attraction: fractions, boundaries, Wada property."""
