"""Declare the analyses of resilience: responses to shocks, and edge states between two attractors."""

from __future__ import annotations

from typing import Literal

from pipeline.products.column import STATES, Columns, in_parts, only, over, with_parts
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, option
from pipeline.results.set_columns import IDENTIFIED_COLUMNS


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


def _shock_columns(name: str, dims: str, text: str, of: str) -> Columns:
    """Return the columns of a search for the smallest shock: those of its results that are named."""
    meanings = {
        "low": "no smaller shock leads away, as far as tried",
        "high": "size of the smallest shock found that leads away",
        "phase": "share of the period at which it happens",
        "to": "attractor where it leads: -1 none, -2 diverges, -3 none of the run's",
        "safe": "largest size of which all directions stayed",
        "n_below": "smaller shocks that were tried and stayed",
        "n_undecided": "smaller shocks whose end is not known",
    }
    return over(dims, **{f"{name}_{one}": f"{text}: {meanings[one]}" for one in of.split()})


_SEARCHED = "low high phase to safe n_below n_undecided"

RESILIENCE_COLUMNS: Columns = (
    *only(IDENTIFIED_COLUMNS, "n_sets attractor kind stability orbit_period n_cells"),
    *over("state", "see state_units", state_scale="size that counts as 1"),
    *over("set state", STATES, shock="smallest critical shock: jump of each state"),
    *over("set state", STATES, shock_from="smallest critical shock: state before it"),
    *_shock_columns("shock", "set", "smallest critical shock", _SEARCHED),
    *over("set state", STATES, distance="shortest way out of the basin: jump of each state"),
    *over("set state", STATES, distance_from="shortest way out of the basin: state before it"),
    *_shock_columns("distance", "set", "shortest way out of the basin", _SEARCHED),
    *over("set state", STATES, along="boundary along a state: jump"),
    *_shock_columns("along", "set state", "boundary along a state", "low high to n_undecided"),
    *with_parts(over("set", basin_stability="share of the cells that end on it"), "low", "high"),
    *with_parts(over("set", weighted_stability="share of the density that ends on it"), "low", "high"),
    *over("set", n_effective="independent cells of equal weight with the same error"),
    *with_parts(over("set", arrived="share of initial states that have arrived in time"), "low", "high"),
    *over(
        "set",
        mean_time="mean time until arrival, {periods}",
        mean_time_stderr="standard error of the mean time",
        longest_time="longest time until arrival, {periods}",
        n_timed="timed initial states that end on it",
        weighted_time="mean time until arrival, weighed by the density, {periods}",
        weighted_arrived="share of the density that has arrived in time",
        amplification="largest factor by which a small disturbance grows",
        quantity="quantity of the option",
    ),
    *over("set", "1/{time}", reactivity="largest growth rate of a small disturbance, at any phase"),
    *over("set", "{time}", amplification_time="time after the disturbance at which it is largest"),
    *over("set", "{time}", return_time="time in which small disturbances shrink by e at last"),
)

RESILIENCE = Analysis(
    "resilience",
    """Measure how attractors respond to shocks: critical shocks, distances to the boundary, arrival times.

    The smallest shock that leads away is searched at phases of the drive, and the boundary of the basin along
    each state and in any direction. All sizes are in units of the states' scales. Undecided trajectories make an
    interval of a size.""",
    ResilienceOptions,
    compute="pipeline.analysis.resilience.analysis:resilience",
    columns=RESILIENCE_COLUMNS,
    table="pipeline.analysis.resilience.analysis:resilience_table",
    needs="pipeline.analysis.resilience.analysis:needs_sweep",
    settle="pipeline.analysis.resilience.analysis:settle_resilience",
    builds_on=("attractors",),
    figure="resilience",
    by_point=True,
    version=2,
)

EDGE_COLUMNS: Columns = (
    *over(
        "edge",
        kind="kind of set",
        orbit_period="period in {periods}",
        residual="scaled residual of Newton's method",
        n_points="section points",
        n_pairs="pairs of cells whose paths end on it",
    ),
    *over("edge", "s", period_s="period"),
    *over("edge point state", STATES, section="section points"),
    *in_parts(over("edge multiplier", multiplier="Floquet multipliers"), "real", "imag"),
    *in_parts(over("edge multiplier", "1/s", eigenvalue="eigenvalues at rest"), "real", "imag"),
    *over("pair", pair_edge="edge state, -1 none", pair_reason="why there is none", n_steps="sections of the path"),
    *over("pair side state", STATES, pair_start="initial states"),
    *over("pair step state", STATES, path="path along the boundary"),
)

EDGE = Analysis(
    "edge",
    """Track the edge states between two attractors: the saddle sets on the boundary of their basins.

    A pair of states, one in each basin, is bisected and integrated in turns. Where it settles on an orbit or an
    equilibrium, Newton's method refines it.""",
    EdgeOptions,
    compute="pipeline.analysis.resilience.edge:edge",
    whole="all pairs advance in step",
    columns=EDGE_COLUMNS,
    table="pipeline.analysis.resilience.edge:edge_table",
    needs="pipeline.analysis.resilience.edge:needs_pair",
    settle="pipeline.analysis.resilience.edge:settle_edge",
    builds_on=("attractors",),
    figure="edge",
)


class ResilienceFigureOptions(ResilienceOptions, FigureOptions):
    """Options of a figure of critical shocks."""


class EdgeFigureOptions(EdgeOptions, FigureOptions):
    """Options of a figure of edge states."""


RESILIENCE_FIGURE = Figure(
    "resilience",
    """Draw basin stability, critical shocks and arrival times of the attractors, over the swept parameter.

    Attractors stand side by side if nothing is swept. Bars show intervals.""",
    ResilienceFigureOptions,
    "pipeline.analysis.resilience.figure:draw",
    needs="pipeline.analysis.resilience.analysis:needs_sweep",
    panels="several",
)


EDGE_FIGURE = Figure(
    "edge",
    "Draw the edge states between two attractors, over the basins of a run on a grid of two states.",
    EdgeFigureOptions,
    "pipeline.analysis.resilience.edge_figure:draw_edge",
    needs="pipeline.analysis.resilience.edge:needs_pair",
)
