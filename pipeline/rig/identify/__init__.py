"""Identify unknown parameters of a model from recordings of a rig."""
