"""Distinguish regular and chaotic motion: Lyapunov exponents, dimensions, the 0-1 test."""
