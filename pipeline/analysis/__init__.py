"""Analyses of a cube: Dataset in, labelled data out. Nothing here integrates."""
