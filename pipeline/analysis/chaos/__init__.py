"""Distinguish regular from chaotic motion by Lyapunov exponents, dimensions and the 0-1 test."""
