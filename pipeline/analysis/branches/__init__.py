"""Periodic orbits as branches along a parameter, and their bifurcations.

    starts = attracting(attractors, parameters, "frequency_hz", 1.0, max_period=4)
    branches = explore(starts, Scope(2.0, 3.0))
    ds = dataset_of(branches, "frequency_hz", parameters)

`problems` has the equations, `lockstep` evaluates many of them in one call of the engine, `arclength`
walks, `bifurcations` notices and locates, `following` makes one branch, `exploring` all that hang
together.
"""

from pipeline.analysis.branches.curves import curves_dataset, curves_from
from pipeline.analysis.branches.dataset import dataset_of, table_of, windows_of
from pipeline.analysis.branches.exploring import Scope, Start, explore
from pipeline.analysis.branches.starts import attracting, orbits_near, recurrent

__all__ = [
    "Scope",
    "Start",
    "attracting",
    "curves_dataset",
    "curves_from",
    "dataset_of",
    "explore",
    "orbits_near",
    "recurrent",
    "table_of",
    "windows_of",
]
