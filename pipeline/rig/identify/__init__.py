"""Identification: parameters of a model from recordings."""
