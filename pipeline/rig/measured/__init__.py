"""Measure diagrams on a rig: sections at the edges of the drive, compared with computed ones."""
