"""Kinds of motion of a run's cells: steady, under a recorded drive, with moving parameters, or with noise.

`Spec.motion` is one of them. `steady.Steady` has all questions that the program asks of a motion, and the others
answer those differently.
"""
