"""Compute how limit cycles answer to small and finite jumps of the states: phase responses, and lines of equal phase.

Reading order: `phases` has the phase of a state and its gradient on a cycle, `analysis` the analysis of a run.
"""
