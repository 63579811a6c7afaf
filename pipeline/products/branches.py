"""Declare the analyses of branches of periodic orbits, and of their bifurcation curves."""

from __future__ import annotations

from pipeline.products.product import Analysis, Options, option

_ROOM = "pipeline.analysis.branches.analysis"


class AlongOptions(Options):
    """Options for an interval of one parameter."""

    parameter: str = option("", "Parameter to follow, or frequency_hz, omega or period; by default the swept one.")
    low: float | None = option(None, "Least value; by default the run's.", unit="SI", flag="--from")
    high: float | None = option(None, "Largest value; by default the run's.", unit="SI", flag="--to")


class PlaneOptions(AlongOptions):
    """Options for a plane of two parameters."""

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


class BranchOptions(AlongOptions, StartOptions):
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


class CurveOptions(BranchOptions, PlaneOptions):
    """Options for continuing bifurcations as curves in a plane of two parameters."""

    curve_period: int = option(
        0, "Longest orbit period; 0 takes all periods of the branches.", unit="drive periods or returns", ge=0
    )


class BandOptions(BranchOptions):
    """Options for carrying draws of the parameters through branches."""

    posterior: str = option(..., "Directory of magpend identify posterior, or a file of its draws.")
    draws: int = option(0, "Number of draws that are carried; 0 takes all.", ge=0)
    digest: str = option("", "Digest of the file of draws; found by itself.")


class SensitivityOptions(BranchOptions):
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


BRANCHES = Analysis(
    "branches",
    """Follow periodic orbits and equilibria along a parameter, stable or not; locate and name their bifurcations.

    Starts from the closed orbits and equilibria on which cells of the run end. Those left out are listed, with
    the option that includes them.""",
    BranchOptions,
    compute=f"{_ROOM}:branches",
    table="pipeline.analysis.branches.analysis:branches_table",
    settle=f"{_ROOM}:settle_branches",
    builds_on=("attractors",),
    figure="branches",
    version=11,
)

CURVES = Analysis(
    "curves",
    """Continue folds, doublings, Neimark-Sacker, Hopf and branch points in the plane of two parameters.

    Starts from the bifurcations that `branches` locates, and from the homoclinic orbits and saddle nodes at which
    branches end.""",
    CurveOptions,
    compute=f"{_ROOM}:curves",
    table="pipeline.analysis.branches.analysis:curves_table",
    settle=f"{_ROOM}:settle_curves",
    builds_on=("branches",),
    figure="curves",
    version=6,
)

BANDS = Analysis(
    "bands",
    """Carry draws of identified parameters through the branches: 95 % intervals of bifurcations, bands about orbits.

    Newton's method carries each orbit and each bifurcation from the run's parameters to those of a draw. The columns
    median, low and high are those of the draws that have the bifurcation.""",
    BandOptions,
    compute="pipeline.analysis.branches.bands:bands",
    table="pipeline.analysis.branches.bands:bands_table",
    settle="pipeline.analysis.branches.bands:settle_bands",
    builds_on=("branches",),
    figure="branches",
    # the digest says which draws
    ignores=("posterior",),
)

SENSITIVITIES = Analysis(
    "sensitivities",
    """Tell how far each bifurcation moves with each parameter: derivatives, and percent per percent.

    By implicit differentiation of the equations of each bifurcation that `branches` locates. With standard deviations
    of the parameters (--deviation, --posterior) also that of the bifurcation, to first order.""",
    SensitivityOptions,
    compute="pipeline.analysis.branches.sensitivities:sensitivities",
    table="pipeline.analysis.branches.sensitivities:sensitivities_table",
    settle="pipeline.analysis.branches.sensitivities:settle_sensitivities",
    builds_on=("branches",),
    figure="sensitivities",
    # the digest says which draws
    ignores=("posterior",),
)

ORBITS = Analysis(
    "orbits",
    """Search all periodic orbits up to a period at a parameter point, stable or not, from many starts.

    Counts how many starts lead to each orbit, estimates how many orbits are missing, and checks the sum of the
    indices. --start adds the orbit near a state, also of a longer period.""",
    OrbitOptions,
    compute="pipeline.analysis.branches.orbit_search:orbits",
    table="pipeline.analysis.branches.orbit_search:orbits_table",
    needs="pipeline.analysis.branches.orbit_search:needs_point",
    version=2,
)


_ROOM = "pipeline.analysis.branches.tongues"


class TongueOptions(PlaneOptions):
    """Options for finding Arnold tongues and following their edges."""

    max_denominator: int = option(5, "Largest q of the tongues p/q.", ge=1, le=64, flag="--denominator")
    at: dict[str, float] = option({}, "Value of a further axis of the run: the row on which tongues are searched.")


TONGUES = Analysis(
    "tongues",
    """Find the Arnold tongues p/q of a plane: where motions lock to the drive, p turns in q drive periods.

    Searches one row of cells with rotation numbers for all fractions up to a denominator. Continues the folds at
    the edges of each tongue in the plane of two parameters.""",
    TongueOptions,
    compute=f"{_ROOM}:tongues",
    table=f"{_ROOM}:tongues_table",
    needs=f"{_ROOM}:needs_rotation",
    settle=f"{_ROOM}:settle_tongues",
    figure="tongues",
)
