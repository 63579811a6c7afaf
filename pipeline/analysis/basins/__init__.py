"""Analyse basins of attraction: their fractions, their boundaries, and the Wada property."""
