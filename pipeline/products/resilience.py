"""Declare the analyses of resilience: responses to shocks, and edge states between two attractors."""

from __future__ import annotations

from typing import Literal

from pipeline.products.product import Analysis, Options, option


class ResilienceOptions(Options):
    """Options for measuring how attractors respond to shocks."""

    at: dict[str, float] = option({}, "Value of an axis of the run; by default all values.")
    states: str = option("", "States that a shock changes, separated by commas; by default the rates.")
    phases: int = option(8, "Phases of a drive period, or of a flow's orbit, at which shocks are tried.", ge=1)
    largest: float = option(2.0, "Largest shock that is tried, in units of the states' scales.", gt=0.0)
    norm: Literal["euclidean", "largest"] = option(
        "euclidean", "Size of a shock: root of the sum of squares of the scaled jumps, or the largest of them."
    )
    directions: int = option(64, "Directions of shocks that change several states.", ge=4)
    confirmations: int = option(256, "Random smaller shocks that are tried against each minimum.", ge=0)
    within: int = option(20, "Time of the finite-time basin stability.", unit="drive periods or returns", ge=0)
    near: float = option(
        0.01, "Distance from its attractor within which a trajectory has arrived, in units of the scales.", gt=0.0
    )
    timed: int = option(256, "Initial states of each parameter point whose arrival is timed.", ge=0)
    density: str = option(
        "1", "Density of the initial states, an expression of states and parameters; it weighs cells and arrival times."
    )
    quantity: str = option(
        "",
        "Quantity of your own: an expression of the results, the parameters, and the states, whose mean over the "
        "basin's cells is taken.",
    )
    interval: Literal["wilson", "clopper-pearson"] = option("wilson", "Confidence interval of the fractions.")
    confidence: float = option(0.95, "Level of the intervals.", gt=0.0, lt=1.0)
    seed: int = option(0, "Seed of directions, random shocks and timed initial states.", ge=0)


class EdgeOptions(Options):
    """Options for tracking edge states between two attractors."""

    at: dict[str, float] = option({}, "Value of an axis of the run, for the parameter point.")
    between: tuple[str, str] = option(..., "The two attractors: their letters or ids in the table of attractors.")
    pairs: int = option(4, "Pairs of initial states that are tracked.", ge=1)
    closest: float = option(1e-8, "Scaled distance to which a pair is bisected.", ge=1e-12)
    farthest: float = option(1e-4, "Scaled distance beyond which a pair is bisected again.", gt=0.0)
    max_period: int = option(
        1,
        "Longest period of the orbits that are sought on a path that does not settle; 0 seeks none.",
        unit="drive periods or returns",
        ge=0,
        flag="--period",
    )
    returns: int = option(200, "Most drive periods or returns for which a pair is tracked.", ge=16)
    seed: int = option(0, "Seed that chooses the pairs.", ge=0)


RESILIENCE = Analysis(
    "resilience",
    """Measure how attractors respond to shocks: critical shocks, distances to the boundary, arrival times.

    The smallest shock that leads away is searched at phases of the drive, and the boundary of the basin along
    each state and in any direction. All sizes are in units of the states' scales. Undecided trajectories make an
    interval of a size.""",
    ResilienceOptions,
    compute="pipeline.analysis.resilience.analysis:resilience",
    table="pipeline.analysis.resilience.analysis:resilience_table",
    needs="pipeline.analysis.resilience.analysis:needs_sweep",
    settle="pipeline.analysis.resilience.analysis:settle_resilience",
    builds_on=("attractors",),
    figure="resilience",
    by_point=True,
    version=2,
)

EDGE = Analysis(
    "edge",
    """Track the edge states between two attractors: the saddle sets on the boundary of their basins.

    A pair of states, one in each basin, is bisected and integrated in turns. Where it settles on an orbit or an
    equilibrium, Newton's method refines it.""",
    EdgeOptions,
    compute="pipeline.analysis.resilience.edge:edge",
    table="pipeline.analysis.resilience.edge:edge_table",
    needs="pipeline.analysis.resilience.edge:needs_pair",
    settle="pipeline.analysis.resilience.edge:settle_edge",
    builds_on=("attractors",),
    figure="edge",
)
