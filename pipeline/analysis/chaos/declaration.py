"""Declare the analyses of chaos: Lyapunov exponents, dimensions, 0-1 test."""

from __future__ import annotations

from typing import Literal

from pipeline.products.column import Columns, only, over, with_parts
from pipeline.products.lyapunov import LyapunovFlag
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, StateOptions, option
from pipeline.results.set_columns import IDENTIFIED_COLUMNS

_ROOM = "pipeline.analysis.chaos.analysis"


class ChaosOptions(Options):
    """Options for telling regular from chaotic motion."""

    n_sigma: float = option(3.0, "Number of standard errors by which an exponent must differ from 0.", gt=0.0)
    least: float = option(0.005, "Least modulus of an exponent that counts as nonzero.", unit="1/s", ge=0.0)
    n_frequencies: int = option(100, "0-1 test: number of frequencies.", ge=10)
    stride: int = option(1, "0-1 test: step between the sections that are used.", ge=1)
    seed: int = option(0, "0-1 test: seed of the frequencies.", ge=0)
    n_max: int = option(2000, "Most section points for the correlation dimension; 0 computes none.", ge=0)


class DimensionOptions(Options):
    """Options for fitting a correlation dimension."""

    at: dict[str, float] = option({}, "Value of an axis of the run; by default all values.")
    theiler: int = option(1, "Theiler window: pairs of sections at most so far apart in time are left out.", ge=0)
    n_max: int = option(10_000, "Most section points of an attractor.", ge=100)
    floor: float = option(1e-6, "Smallest resolved distance, in units of the states' scales.", gt=0.0)


CHAOS_COLUMNS: Columns = (
    *only(
        IDENTIFIED_COLUMNS,
        "n_sets attractor_id status attractor kind stability evidence orbit_period period_s share n_cells lyapunov_max "
        "lyapunov_low lyapunov_high multiplier_real multiplier_imag eigenvalue_real eigenvalue_imag",
    ),
    *over(
        "* +",
        motion="kind of motion by its exponents",
        contradicts="closed, and yet with a positive exponent",
        is_transient="the chaos ended within the blocks",
        drift_sigma="drift in standard errors",
        zero_one="0-1 test, median over frequencies",
        zero_one_low="0-1 test, lower quartile over frequencies",
        zero_one_high="0-1 test, upper quartile over frequencies",
        zero_one_stderr="0-1 test, standard error of the median from the choice of the frequencies",
        zero_one_half="0-1 test of the later half of the sections",
        oversampling="range of the observable over its mean step",
    ),
    *with_parts(over("* +", kaplan_yorke_dimension="Kaplan-Yorke dimension of the section"), "stderr"),
    *over("* +", "1/{time}", drift="largest exponent, later minus earlier half"),
    *over("* +", "1/{time}", audit="sum of the exponents minus the divergence"),
    *with_parts(
        over("* + exponent", lyapunov_per_period="Lyapunov exponents per {period}, in falling order"), "stderr"
    ),
    *over(
        "set",
        nature="what the attractor is",
        exponents_from="where the exponents are from",
        median_zero_one="0-1 test, median over the cells",
        least_zero_one="0-1 test, least over the cells",
        largest_zero_one="0-1 test, largest over the cells",
        n_drifting="cells whose largest exponent drifts",
        n_transient="cells whose chaos ended",
        n_contradicting="cells that closed, and yet have a positive exponent",
        attractor_correlation="correlation dimension of the section",
        attractor_correlation_spread="slope of the lower half of the range minus the upper",
        attractor_correlation_stderr="sampling error of the correlation dimension",
    ),
    *over("set", **{f"n_{flag.name.lower()}": f"cells flagged: {flag.sentence}" for flag in LyapunovFlag if flag > 1}),
    *with_parts(over("set", attractor_kaplan_yorke="Kaplan-Yorke dimension of the section"), "stderr"),
    *over("set rank", "1/{time}", attractor_lyapunov="Lyapunov exponents per unit time"),
    *over("set rank", "1/{time}", attractor_lyapunov_stderr="their standard errors"),
    *over("set rank", "1/{time}", attractor_lyapunov_between="standard deviation between cells beyond their errors"),
    *over("rank", rank="exponents in falling order"),
)

CHAOS = Analysis(
    "chaos",
    """Tell regular from chaotic attractors: exponents, multipliers, dimensions, 0-1 test.

    Prints a line per attractor, or with more than six points the ranges in which each kind of motion
    occurs. Exponents of orbits follow from their multipliers. Exponents of other sets need [products]
    lyapunov in the run's specification. The 0-1 test needs 200 sections.""",
    ChaosOptions,
    compute=f"{_ROOM}:chaos",
    columns=CHAOS_COLUMNS,
    table="pipeline.analysis.chaos.analysis:chaos_table",
    builds_on=("attractors",),
    figure="lyapunov",
    by_point=True,
)

DIMENSION_COLUMNS: Columns = (
    *only(IDENTIFIED_COLUMNS, "n_sets attractor kind stability share n_cells n_sampled n_left lifetime_low"),
    *over(
        "set",
        n_points="points of the set",
        reason="why there is no dimension",
        correlation_dimension="correlation dimension of the section",
        correlation_dimension_stderr="sampling error of the correlation dimension",
        correlation_dimension_spread="slope of the lower half of the range minus the upper",
        largest_resolved="largest dimension that so many points can show",
        fit_low="least radius of the fit, scaled",
        fit_high="largest radius of the fit, scaled",
    ),
    *over("set radius", log_radius="natural logarithm of the scaled radius"),
    *over("set radius", log_correlation_sum="natural logarithm of the correlation sum"),
)

DIMENSION = Analysis(
    "dimension",
    """Measure the correlation dimension of each set that attracts and does not close.

    A sample of each set is integrated further first, as in `settling`, since transients and motions that
    are still closing have no dimension. This takes seconds per parameter point. Two digits need thousands
    of sections.""",
    DimensionOptions,
    compute=f"{_ROOM}:dimension",
    columns=DIMENSION_COLUMNS,
    table="pipeline.analysis.chaos.analysis:dimension_table",
    needs=f"{_ROOM}:needs_dimension",
    settle=f"{_ROOM}:settle_dimension",
    builds_on=("attractors",),
    figure="dimension",
    by_point=True,
)


Per = Literal["s", "period"]


class LyapunovFigureOptions(StateOptions):
    """Options of a figure of Lyapunov exponents over one parameter, or in the plane of two."""

    spectrum: bool = option(False, "Draw all stored exponents, not only the largest.")
    as_map: bool = option(False, "Draw a map over two parameters instead of a diagram over one.", flag="--map")
    per: Per = option("s", "Exponents per second, or per drive period or return.")

    def label(self) -> str:
        """Return the part of the figure's file name that lists the options. It omits the state if the figure shows a
        plane of two parameters.
        """
        return self.label_without("state") if self.as_map else super().label()


class ConvergenceOptions(FigureOptions):
    """Options of a figure of the convergence of Lyapunov exponents."""

    exponent: int = option(1, "Index of the exponent; 1 is the largest.", ge=1)
    per: Per = option("s", "Exponents per second, or per drive period or return.")


class DimensionFigureOptions(DimensionOptions, FigureOptions):
    """Options of a figure of a correlation sum and its fit."""


LYAPUNOV_FIGURE = Figure(
    "lyapunov",
    "Draw Lyapunov exponents, under the bifurcation diagram or as a map over two parameters.",
    LyapunovFigureOptions,
    "pipeline.analysis.chaos.lyapunov_figure:draw",
    panels="several",
    unless=("as_map", True),
)


CONVERGENCE_FIGURE = Figure(
    "convergence",
    "Draw the convergence of the Lyapunov exponents of the cells at one parameter point.",
    ConvergenceOptions,
    "pipeline.analysis.chaos.convergence_figure:draw",
    panels="several",
)


DIMENSION_FIGURE = Figure(
    "dimension",
    "Draw the correlation sum of the chaotic sections of one parameter point, with fit and local slope.",
    DimensionFigureOptions,
    "pipeline.analysis.chaos.dimension_figure:draw",
    panels="several",
)
