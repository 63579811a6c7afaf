"""Declare the products of a run: results computed per cell, and the analyses and figures of its result cube."""
