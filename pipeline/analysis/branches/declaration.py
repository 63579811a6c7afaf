"""Declare the analyses of branches of periodic orbits, and of their bifurcation curves."""

from __future__ import annotations

from typing import Literal

from pipeline.products.column import STATES, UNITS, Column, Columns, in_parts, only, over, swept, with_parts
from pipeline.products.diagrams import POSTERIOR, PointOptions
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, StateOptions, option

_ROOM = "pipeline.analysis.branches.analysis"


class AlongOptions(Options):
    """Options for one parameter, along which branches run."""

    parameter: str = option("", "Parameter to follow, or frequency_hz, omega or period; by default the swept one.")


class IntervalOptions(AlongOptions):
    """Options for an interval of one parameter."""

    low: float | None = option(None, "Least value; by default the run's.", unit="SI", flag="--from")
    high: float | None = option(None, "Largest value; by default the run's.", unit="SI", flag="--to")


class SecondOptions(Options):
    """Options for an interval of a second parameter."""

    second: str = option(..., "Second parameter: its name, such as q, or frequency_hz, omega or period.")
    second_low: float = option(..., "Least value of the second parameter.", unit="SI", flag="--second-from")
    second_high: float = option(..., "Largest value of the second parameter.", unit="SI", flag="--second-to")


class StartOptions(Options):
    """Options for a state from which to start."""

    start: dict[str, float] = option(
        {},
        "Also start from this state, such as x=0.1,v=0; along branches the parameter may be among them, in any of its "
        "words.",
    )
    start_period: int = option(
        1,
        "Period of the orbit near --start. Of branches 0 is an equilibrium; flows without a section have only these.",
        unit="drive periods or returns",
        ge=0,
    )


class BranchOptions(IntervalOptions, StartOptions):
    """Options for continuing branches of periodic orbits."""

    max_period: int = option(
        0,
        "Longest orbit period of a branch; 0 follows all orbits that attract cells, and doublings up to the "
        "longest of them, at least up to 4.",
        unit="drive periods or returns",
        ge=0,
        flag="--period",
    )
    generations: int = option(3, "Number of generations of bifurcating branches that are followed.", ge=0)
    recurrences: int = option(
        0, "Also start from orbits up to this period, near close recurrences of bounded cells.", ge=0
    )
    isolas: int = option(
        0,
        "Number of parameter values, evenly spaced, at which all orbits are searched, also those of detached "
        "branches; up to --period, or the longest period of the run's orbits, at most 4.",
        ge=0,
    )
    stable: bool = option(
        False, "Follow stable parts only, and a little of what lies beyond: much faster if there are many attractors."
    )
    all_equilibria: int = option(
        0,
        "Number of parameter values, evenly spaced, at which all equilibria of a flow in the box --within are found, "
        "as starts.",
        ge=0,
    )
    within: dict[str, tuple[float, float]] = option(
        {}, "Range of a state for --all-equilibria, such as x=-2:2; of an angle by default the full turn."
    )


class CurveOptions(AlongOptions, SecondOptions):
    """Options for continuing bifurcations as curves in a plane of two parameters."""

    curve_period: int = option(
        0, "Longest orbit period; 0 takes all periods of the branches.", unit="drive periods or returns", ge=0
    )


class BandOptions(AlongOptions):
    """Options for carrying draws of the parameters through branches."""

    posterior: str = option(..., "Directory of magpend identify posterior, or a file of its draws.")
    draws: int = option(0, "Number of draws that are carried; 0 takes all.", ge=0)
    digest: str = option("", "Digest of the file of draws; found by itself.")


class SensitivityOptions(AlongOptions):
    """Options for derivatives of bifurcations by the parameters."""

    deviation: dict[str, float] = option(
        {}, "Standard deviation of a parameter, such as q=0.02; in Hz of the drive's frequency_hz."
    )
    posterior: str = option("", "Directory of magpend identify posterior, or a file of its draws: their covariance.")
    digest: str = option("", "Digest of the file of draws; found by itself.")


class OrbitOptions(StartOptions):
    """Options for searching all periodic orbits at a parameter point."""

    at: dict[str, float] = option({}, "Value of an axis of the run, for the parameter point.")
    max_period: int = option(2, "Longest orbit period.", unit="drive periods or returns", ge=1, flag="--period")
    starts: int = option(400, "Number of starts for each period: half of them sections of cells, half random.", ge=2)
    rounds: int = option(6, "Most rounds in which known orbits are deflated.", ge=0)
    seed: int = option(0, "Seed of the random starts.", ge=0)


BRANCH_COLUMNS: Columns = (
    *over(
        "branch",
        orbit_period="period in {periods}, 0 for equilibria",
        n_points="points of the branch",
        origin="bifurcation it sprang from, -1 none",
        first_end="why it begins",
        last_end="why it ends",
    ),
    *over("branch", "Hz", frequency="drive frequency, NaN if it varies"),
    *over("branch angle", rotation="turns per {period}"),
    *over("angle", angle="angle"),
    *swept("parameter", "branch point", "value of the parameter"),
    *over("branch point", n_unstable="multipliers outside the unit circle, -1 beyond the branch"),
    *over("branch point", residual="scaled distance of the point from its image", side="class of the whole orbit"),
    *over("branch point", "s", period_s="period of the orbit"),
    *over("branch point phase state", STATES, section="section points of the orbit"),
    *in_parts(over("branch point multiplier", multiplier="Floquet multipliers"), "real", "imag"),
    *in_parts(over("branch point multiplier", "1/s", eigenvalue="eigenvalues of an equilibrium"), "real", "imag"),
    *over(
        "branch end",
        "{parameter}",
        limit_value="parameter value where the period is infinite",
        limit_error="error of this value",
    ),
    *over("branch end rest state", STATES, limit_state="equilibria where the period is infinite"),
    *in_parts(
        over("branch end multiplier", "1/s", limit_eigenvalue="eigenvalues of the first of them"), "real", "imag"
    ),
    *over(
        "branch end",
        "s, or s times the root of the parameter's unit",
        limit_slope="fitted slope of the period over -ln|p - p_h|; at a saddle node on a circle over 1/sqrt|p - p_h|",
        limit_slope_error="error of the fitted slope",
        limit_slope_expected="the same slope, from the equilibria",
    ),
    *over(
        "bifurcation",
        kind="kind of bifurcation",
        of_branch="branch on which it lies",
        after="point of the branch that it comes after",
        to_branch="other branch through it, -1 none",
        image="bifurcation that is its mirror image, -1 none",
        bifurcation_side="class of the orbit there",
        n_unstable_before="unstable multipliers before, along the branch",
        n_unstable_after="unstable multipliers after, along the branch",
        rises_before="1 if the parameter rises along the branch before",
        criticality="criticality",
        normal_form="normal form coefficient; of a Hopf point in 1/s",
        normal_form_error="error of the coefficient",
    ),
    *in_parts(over("bifurcation", critical="critical multiplier, or eigenvalue in 1/s"), "real", "imag"),
    *swept("value", "bifurcation", "parameter value of the bifurcation", "bifurcation_{parameter}"),
    *over("bifurcation", "{parameter}", bracket="width of the bracket in the parameter"),
    *over("bifurcation", "s", bifurcation_period_s="period of the orbit, or of a Hopf point's cycles"),
    *over("bifurcation phase state", STATES, bifurcation_section="section points of the orbit there"),
    *in_parts(over("bifurcation multiplier", bifurcation_multiplier="multipliers there"), "real", "imag"),
    *over("searched", "{parameter}", searched_value="value of the parameter at which orbits were sought"),
    *over("searched", coverage="share of starts that lead to a known orbit"),
    *over("times", times="multiple of a {period}"),
    *over(
        "searched times",
        n_orbits="orbits of this least period",
        index_sum="sum of the indices of the orbits that close in so many {periods}",
        index_verdict="whether the indices add up to what they must",
    ),
    *over("box", "{parameter}", box_value="value of the parameter at which equilibria were counted"),
    *over(
        "box",
        n_equilibria="equilibria in the box",
        n_stable_equilibria="stable equilibria in the box",
        equilibria_index_sum="sum of the signs of det(-J); of a bounded flow known for all equilibria",
        box_verdict="whether the number is proved",
    ),
)

BRANCHES = Analysis(
    "branches",
    """Follow periodic orbits and equilibria along a parameter, stable or not; locate and name their bifurcations.

    Starts from the closed orbits and equilibria on which cells of the run end. Those left out are listed, with
    the option that includes them. Options that are given hold for the run from then on: all other analyses and figures
    rest on these branches along the parameter.""",
    BranchOptions,
    compute=f"{_ROOM}:branches",
    whole="all branches are followed in step, and none where another one is known",
    columns=BRANCH_COLUMNS,
    table="pipeline.analysis.branches.analysis:branches_table",
    settle=f"{_ROOM}:settle_branches",
    builds_on=("attractors",),
    figure="branches",
    version=15,
)

COEFFICIENTS = {
    **{"a": "1/s2", **dict.fromkeys(("b", "c", "e", "p11", "p22", "quintic"), "1/s")},
    **dict.fromkeys(("lyapunov2", "s", "theta", "delta"), "1"),
}
"""Coefficients of the normal forms of equilibria at points of codimension two, with their units (`center_manifold`)."""

CURVE_COLUMNS: Columns = (
    *over(
        "curve",
        kind="kind of bifurcation",
        orbit_period="period in {periods}, 0 for equilibria",
        start="located point from which it was followed",
        n_points="points of the curve",
        n_missed="sign changes that could not be located",
        first_end="why it begins",
        last_end="why it ends",
    ),
    *swept("first", "curve point", "value of the first parameter", "{first_parameter}"),
    *swept("second", "curve point", "value of the second parameter", "{second_parameter}"),
    *over("curve point state", STATES, section="a section point, or the saddle"),
    *over("curve point", residual="largest residual, test function included"),
    *over("curve point", "1/s", saddle_quantity="sum of the leading eigenvalues of the saddle of a homoclinic orbit"),
    *over(
        "special",
        special_kind="kind of point",
        special_curve="curve on which it was located",
        special_period="period in {periods}, 0 for equilibria",
    ),
    *swept("special_first", "special", "value of the first parameter", "special_{first_parameter}"),
    *over("special", "{first_parameter}", special_first_error="error of this value"),
    *swept("special_second", "special", "value of the second parameter", "special_{second_parameter}"),
    *over("special", "{second_parameter}", special_second_error="error of this value"),
    *over("special state", STATES, special_section="a section point"),
    *(Column(f"special_{n}", "special", f"normal form coefficient {n}", unit) for n, unit in COEFFICIENTS.items()),
)

CURVES = Analysis(
    "curves",
    """Continue folds, doublings, Neimark-Sacker, Hopf and branch points in the plane of two parameters.

    Starts from the bifurcations that `branches` locates, and from the homoclinic orbits and saddle nodes at which
    branches end.""",
    CurveOptions,
    compute=f"{_ROOM}:curves",
    whole="all curves are followed in step, and none where another one is known",
    columns=CURVE_COLUMNS,
    table="pipeline.analysis.branches.analysis:curves_table",
    settle=f"{_ROOM}:settle_curves",
    builds_on=("branches",),
    figure="curves",
    version=7,
)

BAND_COLUMNS: Columns = (
    *only(BRANCH_COLUMNS, "kind value of_branch bifurcation_section"),
    *over("bifurcation", orbit_period="period in {periods}, 0 for equilibria"),
    *over("bifurcation", is_border="1 if a stable orbit begins or ends there"),
    *over(
        "draw bifurcation", "{parameter}", bifurcation_value="value for the draw, NaN where it has no such bifurcation"
    ),
    *over("level", level="level of a quantile over the draws"),
    *over("level orbit phase state", STATES, section_level="quantiles of the section points of an orbit"),
    *over("orbit", "{parameter}", parameter_value="value of the parameter"),
    *over(
        "orbit",
        branch="branch on which the orbit lies",
        run="number of the stretch of the branch",
        step="place of the orbit on the stretch",
        is_stable="1 if the orbit is stable",
        share="share of the draws that have the orbit",
    ),
)

BANDS = Analysis(
    "bands",
    """Carry draws of identified parameters through the branches: 95 % intervals of bifurcations, bands about orbits.

    Newton's method carries each orbit and each bifurcation from the run's parameters to those of a draw. The columns
    median, low and high are those of the draws that have the bifurcation.""",
    BandOptions,
    compute="pipeline.analysis.branches.bands:bands",
    parts="pipeline.analysis.branches.bands:drawn_parameters",
    rows="draw",
    together=16,
    finish="pipeline.analysis.branches.bands:with_levels",
    columns=BAND_COLUMNS,
    table="pipeline.analysis.branches.bands:bands_table",
    settle="pipeline.analysis.branches.bands:settle_bands",
    builds_on=("branches",),
    figure="branches",
    # the digest says which draws
    ignores=("posterior",),
)

SENSITIVITY_COLUMNS: Columns = (
    *only(BRANCH_COLUMNS, "kind of_branch bifurcation_side value"),
    *over("bifurcation", orbit_period="period in {periods}, 0 for equilibria"),
    *over("bifurcation", "{parameter}", deviation="standard deviation of the value, to first order"),
    *over("bifurcation parameter", status="whether the derivative is known"),
    *over("bifurcation parameter", UNITS, parameter_value="value of the parameter"),
    *with_parts(
        over("bifurcation parameter", "{parameter} per unit", derivative="derivative of the value by the parameter"),
        "error",
    ),
    *with_parts(
        over("bifurcation parameter", elasticity="relative change of the value over that of the parameter"), "error"
    ),
    *over("parameter", parameter="name of the parameter", unit="unit of the parameter"),
    *over("parameter", UNITS, parameter_deviation="standard deviation of the parameter"),
)

SENSITIVITIES = Analysis(
    "sensitivities",
    """Tell how far each bifurcation moves with each parameter: derivatives, and percent per percent.

    By implicit differentiation of the equations of each bifurcation that `branches` locates. With standard deviations
    of the parameters (--deviation, --posterior) also that of the bifurcation, to first order.""",
    SensitivityOptions,
    compute="pipeline.analysis.branches.sensitivities:sensitivities",
    parts="pipeline.analysis.branches.sensitivities:numbered_bifurcations",
    rows="bifurcation",
    finish="pipeline.analysis.branches.sensitivities:with_deviations",
    columns=SENSITIVITY_COLUMNS,
    table="pipeline.analysis.branches.sensitivities:sensitivities_table",
    settle="pipeline.analysis.branches.sensitivities:settle_sensitivities",
    builds_on=("branches",),
    figure="sensitivities",
    # the digest says which draws
    ignores=("posterior",),
)

ORBIT_COLUMNS: Columns = (
    *over(
        "orbit",
        orbit_period="least period in {periods}",
        n_unstable="multipliers outside the unit circle",
        index="sign of det(1 - M)",
        n_hits="starts of the first round that led to it",
        search_round="round in which it was found, from 0",
    ),
    *over("orbit", "s", period_s="least period"),
    *over("orbit phase state", STATES, section="section points of the orbit"),
    *in_parts(over("orbit multiplier", multiplier="Floquet multipliers"), "real", "imag"),
    *over("times", times="multiple of a {period}"),
    *over("times", index_sum="sum of the indices of the orbits that close in so many {periods}"),
)

ORBITS = Analysis(
    "orbits",
    """Search all periodic orbits up to a period at a parameter point, stable or not, from many starts.

    Counts how many starts lead to each orbit, estimates how many orbits are missing, and checks the sum of the
    indices. --start adds the orbit near a state, also of a longer period.""",
    OrbitOptions,
    compute="pipeline.analysis.branches.orbit_search:orbits",
    whole="all starts are in one call of the engine, and known orbits are avoided",
    columns=ORBIT_COLUMNS,
    table="pipeline.analysis.branches.orbit_search:orbits_table",
    needs="pipeline.analysis.branches.orbit_search:needs_point",
    version=2,
)


_ROOM = "pipeline.analysis.branches.tongues"


class TongueOptions(IntervalOptions, SecondOptions):
    """Options for finding Arnold tongues and following their edges."""

    max_denominator: int = option(5, "Largest q of the tongues p/q.", ge=1, le=64, flag="--denominator")
    at: dict[str, float] = option({}, "Value of a further axis of the run: the row on which tongues are searched.")


TONGUE_COLUMNS: Columns = (
    *CURVE_COLUMNS,
    *over("curve", numerator="numerator of the rotation number", denominator="denominator of the rotation number"),
    *over(
        "tongue",
        tongue_numerator="numerator of the rotation number",
        tongue_denominator="denominator of the rotation number",
        n_branches="branches that lie in the tongue",
        tongue_low_kind="what ends the tongue below",
        tongue_high_kind="what ends the tongue above",
    ),
    *over(
        "tongue",
        "{first_parameter}",
        tongue_low="lower end of the tongue on the row",
        tongue_high="upper end of the tongue on the row",
        tongue_error="largest error of the two ends",
    ),
)

TONGUES = Analysis(
    "tongues",
    """Find the Arnold tongues p/q of a plane: where motions lock to the drive, p turns in q drive periods.

    Searches one row of cells with rotation numbers for all fractions up to a denominator. Continues the folds at
    the edges of each tongue in the plane of two parameters.""",
    TongueOptions,
    compute=f"{_ROOM}:tongues",
    whole="all orbits and edges are followed in step",
    columns=TONGUE_COLUMNS,
    table=f"{_ROOM}:tongues_table",
    needs=f"{_ROOM}:needs_rotation",
    settle=f"{_ROOM}:settle_tongues",
    figure="tongues",
)


class BranchFigureOptions(AlongOptions, PointOptions, StateOptions):
    """Options of a figure of branches of periodic orbits over a bifurcation diagram."""

    over: str = option("", "Run whose diagram is drawn below; it must sweep the same parameter. By default DIR.")
    posterior: str = option("", POSTERIOR)
    shown: int | None = option(None, "Longest orbit period that is drawn.", unit="drive periods or returns", ge=1)


class MultiplierOptions(AlongOptions, FigureOptions):
    """Options of a figure of Floquet multipliers along a branch."""

    branch: int = option(0, "Index of the branch, as in the table.", ge=0)


class CurveFigureOptions(CurveOptions, FigureOptions):
    """Options of a figure of bifurcation curves."""

    over: str = option("", "Run over both parameters whose map of regimes is drawn below.")
    show: Literal["periods", "attractors", "number"] = option("periods", "Property that is coloured.")


class SensitivityFigureOptions(SensitivityOptions, FigureOptions):
    """Options of a figure of sensitivities."""

    shown: int = option(6, "Number of bifurcations that get a panel: the first by rising value.", ge=1, le=24)


class TongueFigureOptions(TongueOptions, FigureOptions):
    """Options of a figure of Arnold tongues."""


BRANCHES_FIGURE = Figure(
    "branches",
    "Draw branches of periodic orbits over the bifurcation diagram: solid stable, dashed unstable.",
    BranchFigureOptions,
    "pipeline.analysis.branches.figure:draw_branches",
)


MULTIPLIERS_FIGURE = Figure(
    "multipliers",
    "Draw the Floquet multipliers along a branch in the complex plane, with the unit circle.",
    MultiplierOptions,
    "pipeline.analysis.branches.figure:draw_multipliers",
)


SENSITIVITIES_FIGURE = Figure(
    "sensitivities",
    "Draw how far 1 % more of each parameter moves each bifurcation: bars by size, a panel for each bifurcation.",
    SensitivityFigureOptions,
    "pipeline.analysis.branches.sensitivities_figure:draw_sensitivities",
    panels="several",
)


CURVES_FIGURE = Figure(
    "curves",
    "Draw curves of folds, period doublings and Neimark-Sacker points in the plane of two parameters.",
    CurveFigureOptions,
    "pipeline.analysis.basins.regimes_figure:draw_curves",
)


ROTATION_FIGURE = Figure(
    "rotation",
    "Draw rotation numbers over a parameter, with the steps p/q (the devil's staircase), or as a map over two.",
    FigureOptions,
    "pipeline.analysis.branches.tongues_figure:draw_rotation",
)


TONGUES_FIGURE = Figure(
    "tongues",
    "Draw the edges of the Arnold tongues p/q in a plane, over the map of rotation numbers if the run spans it.",
    TongueFigureOptions,
    "pipeline.analysis.branches.tongues_figure:draw_tongues",
    needs="pipeline.analysis.branches.tongues:needs_rotation",
)
