"""Name the events of attractors; this module imports no kernel, so that figures and tables need no compiler."""

from __future__ import annotations

from pipeline.analysis.branches.kinds import KINDS, LIMITS

UNDECIDED, RANGE_END, LIVES_ON, CASCADE = "not_decided", "range_end", "lives_on", "cascade"

BOUNDARY, INTERIOR, BANDS, TWINS = "boundary_crisis", "interior_crisis", "band_merging", "attractor_merging"
CRISES = (BOUNDARY, INTERIOR, BANDS, TWINS)
"""Crises: a chaotic set is lost, grows, or merges its bands or with another set, as it meets an unstable orbit."""

INTERMITTENCY = {kind: f"intermittency_{kind}" for kind in ("i", "ii", "iii")}
"""Names of intermittency by its type."""

LOCKING, GRAZING, BREAKUP, SLIDING = "locking", "grazing", "torus_breakup", "grazing_sliding"

NAMES = (
    *(UNDECIDED, RANGE_END, LIVES_ON, *KINDS, *LIMITS, CASCADE, *CRISES),
    *(*INTERMITTENCY.values(), LOCKING, GRAZING, BREAKUP, SLIDING),
)
"""Names of events. An attractor *lives on* if it is stable up to the bound of the branches, but no cell found it."""
