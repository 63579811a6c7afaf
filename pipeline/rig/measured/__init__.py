"""Measured diagrams: sections at the edges of the drive, beside and over computed ones."""
