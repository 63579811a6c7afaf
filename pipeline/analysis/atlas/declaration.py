"""Declare the atlas of a plane of two parameters, and what it rests on."""

from __future__ import annotations

from pipeline.analysis.branches.declaration import CURVE_COLUMNS
from pipeline.products.column import STATES, Columns, over, swept, with_parts
from pipeline.products.product import Analysis, Figure, FigureOptions, Options, option

_ROOM = "pipeline.analysis.atlas.analysis"


class PlaneOptions(Options):
    """Options that choose the plane of two parameters."""

    parameter: str = option("", "First parameter, along the horizontal axis; by default the run's first axis.")
    second: str = option("", "Second parameter, along the vertical axis; by default the run's other axis.")
    at: dict[str, float] = option({}, "Value of a further axis of the run.")
    budget: int = option(
        0,
        "Most cells at further points, beside the run: between neighbours whose orbits end without an explanation, and "
        "in regions where fewer than 299 cells are known.",
        ge=0,
    )


class SetEndOptions(PlaneOptions):
    """Options for naming the ends of chaotic sets and tori."""

    windows: int = option(
        24,
        "Places at which ends of chaotic sets and tori are named, as analyse events does; the places between take the "
        "name on which those beside them agree. 0 names none.",
        ge=0,
    )


class AtlasOptions(SetEndOptions):
    """Options of the atlas."""

    curve_period: int = option(
        4,
        "Longest orbit period whose bifurcations are continued as curves; those of longer orbits are joined to lines.",
        unit="drive periods or returns",
        ge=1,
    )
    isolas: int = option(
        0,
        "Number of points of the grid, evenly spaced, at which all orbits up to --curve-period are searched: those on "
        "which no cell ends, as of detached branches, lead to further curves.",
        ge=0,
    )


def _plane(role: str, dims: str, text: str) -> Columns:
    """Return the columns of a point of the plane: its values of both parameters."""
    return tuple(
        column
        for which in ("first", "second")
        for column in swept(
            f"{role}_{which}", dims, f"{text}, value of the {which} parameter", f"{role}_{{{which}_parameter}}"
        )
    )


ENDS_COLUMNS: Columns = (
    *over(
        "end",
        set_row="row of the attractor",
        what="what ends it",
        end_period="period of the orbit there",
        why="evidence, or why it was not followed",
        end_error="error of the place, in units of the plane",
    ),
    *_plane("end", "end", "place of the end"),
    *over("end state", STATES, end_section="a section point there"),
)

FURTHER_COLUMNS: Columns = (
    *_plane("point", "further", "further point"),
    *over(
        "further",
        at_node="point of the grid at which it has more starts, -1 none",
        point_cells="cells",
        point_known="cells with a known outcome",
    ),
    *over("further side", between_nodes="points between which it lies, -1 none"),
    *over(
        "set",
        of_point="further point",
        set_kind="kind of the attractor",
        set_period="period of the attractor, 0 none",
        set_cells="cells on it",
        set_is_polished="whether Newton's method converged",
        set_points="stored section points",
    ),
    *over("sample state", STATES, further_section="section points"),
)

FURTHER = Analysis(
    "further",
    "Run further parameter points where an atlas is worst, and find their attractors.",
    PlaneOptions,
    compute=f"{_ROOM}:further",
    whole="it runs points beside the run, whose cells are spread over all workers",
    columns=FURTHER_COLUMNS,
    settle=f"{_ROOM}:settle_plane",
    builds_on=("attractors", "atlas", "identified"),
)

ORBIT_ENDS = Analysis(
    "orbit_ends",
    "Follow each orbit that a neighbouring parameter point lacks to its end.",
    PlaneOptions,
    compute=f"{_ROOM}:orbit_ends",
    columns=ENDS_COLUMNS,
    parts=f"{_ROOM}:ways",
    rows="end",
    together=32,
    settle=f"{_ROOM}:settle_plane",
    builds_on=("attractors", "further"),
)

SET_ENDS = Analysis(
    "set_ends",
    "Name the ends of chaotic sets and tori between neighbouring parameter points.",
    SetEndOptions,
    compute=f"{_ROOM}:set_ends",
    columns=ENDS_COLUMNS,
    parts=f"{_ROOM}:windows",
    rows="end",
    settle=f"{_ROOM}:settle_plane",
    builds_on=("attractors", "further"),
)

ATLAS_COLUMNS: Columns = (
    *CURVE_COLUMNS,
    *over(
        "curve",
        n_crossed="pairs of neighbouring points between which its stable part passes",
        n_effects="of these, pairs whose attractors it changes",
        effect="why no change is seen at the other pairs, or anywhere",
    ),
    *over("curve point", others_unstable="unstable multipliers beside the critical ones"),
    *_plane("searched", "searched", "point at which all orbits were searched"),
    *over(
        "searched",
        n_orbits="orbits found there",
        n_hidden="stable ones of them on which no cell ends",
        index_verdict="whether the indices of the orbits add up to what they must",
    ),
    *over("line", line_what="what lies on the line", line_period="period of the orbit, 0 none"),
    *over("line", line_size="points of the line"),
    *_plane("line", "line vertex", "point of the line"),
    *over(
        "change",
        change_attractor="id of the attractor that ends",
        change_set="kind of the attractor",
        change_period="period of the attractor, 0 none",
        period_after="period of the same attractor at the neighbour, -1 if it is not there",
        what="what explains the change",
        on_curve="curve that explains it, -1 none",
        on_line="line on which it lies, -1 none",
        change_cells="cells on the attractor",
        why="evidence, or what was tried",
    ),
    *_plane("change", "change", "place of the change"),
    *over("change", change_error="error of the place, in units of the plane"),
    *_plane("here", "change", "point with the attractor"),
    *_plane("there", "change", "its neighbour"),
    *over(
        "region",
        area="share of the plane",
        region_points="parameter points in it",
        region_cells="cells with a known outcome in it",
        is_thin="1 if so few cells may miss a basin of 1 %",
        region_label="periods of its attractors",
    ),
    *_plane("label", "region", "point well inside"),
    *over("node", node_region="region of a parameter point, the second parameter varying first; further points last"),
    *over(
        "member",
        of_region="region",
        member_attractor="id of an attractor that is met in the region",
        member_set="kind of the attractor",
        member_period="period of the attractor, 0 none",
        member_points="parameter points at which it is met",
    ),
    *with_parts(over("member", member_share="share of the cells of the region"), "low", "high"),
    *over("border", between="curve or line between two regions", border_length="length, in units of the plane"),
    *over("border side", neighbour="regions on both sides"),
    *over("ring", ring_region="region that it bounds", ring_size="corners", is_hole="1 if it bounds a hole"),
    *_plane("corner", "corner", "corner of a ring"),
)

ATLAS = Analysis(
    "atlas",
    """Chart a plane of two parameters: its curves, the regions between them, and each change that none explains.

    Each attractor that a neighbouring parameter point lacks is followed to its end. Bifurcations are continued as
    curves, the plane is cut into regions, and each change is listed with what explains it, or as not explained. Curves
    without an effect on attractors say why.""",
    AtlasOptions,
    compute=f"{_ROOM}:atlas",
    whole="curves are followed in step; the orbits' ends before are in parts",
    columns=ATLAS_COLUMNS,
    table="pipeline.analysis.atlas.table:atlas_table",
    settle=f"{_ROOM}:settle_plane",
    builds_on=("orbit_ends", "set_ends"),
    figure="atlas",
)


class AtlasFigureOptions(AtlasOptions, FigureOptions):
    """Options of the figure of the atlas."""


ATLAS_FIGURE = Figure(
    "atlas",
    "Draw the atlas of a plane: regions by their attractors, curves by kind, changes that are not explained.",
    AtlasFigureOptions,
    "pipeline.analysis.atlas.figure:draw_atlas",
)
