"""Identify parameters of a model from recordings."""
