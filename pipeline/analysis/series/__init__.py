"""Measure what a time series says of its dynamics: periods, exponents, dimensions, and whether they are decided."""
