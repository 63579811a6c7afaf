"""Measured points over diagrams and branches: their levels, the ranges of the axes, and the data of the figure."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from magpend_core.status import Status
from pipeline.analysis.branches import figure as branches
from pipeline.analysis.branches.declaration import BranchFigureOptions
from pipeline.layout.own_words import RATE
from pipeline.plots import Frame, bifurcation
from pipeline.plots.measured import by_level
from pipeline.products.diagrams import BifurcationOptions
from pipeline.results.points import read_points
from pipeline.specification.problems import SpecError
from tests.pipeline.plots.made_up import DUFFING, PENDULUM, STATES, legend_texts

HERTZ = [1.0, 2.0]
TURN = 2.0 * np.pi


def cube(model=DUFFING, states=("x", "v"), **attrs):
    """A sweep of the force at two frequencies: every section point is 0.1 times the force."""
    force = np.linspace(1.0, 3.0, 5)
    section = np.broadcast_to(0.1 * force[None, :, None, None, None], (2, 5, 1, 2, len(states))).copy()
    return xr.Dataset(
        {
            "section": (("frequency", "amplitude", "initial_condition", "period_index", "state"), section),
            "status": (("frequency", "amplitude", "initial_condition"), np.full((2, 5, 1), Status.PERIODIC, np.int8)),
        },
        coords={
            "state": list(states),
            "frequency": ("frequency", HERTZ, {"units": "Hz", "long_name": "drive frequency"}),
            "amplitude": ("amplitude", force, {"units": "1", "long_name": "amplitude"}),
        },
        attrs={**model, **attrs},
    )


def run_of(ds, found=None):
    """A run with a cube, and perhaps with branches."""
    model = load_model(str(ds.attrs["model"]))
    return SimpleNamespace(cube=lambda: ds, model=model, derive=lambda name, **options: found, of=None)


def measured(figure):
    """Coordinates of the drawn measured points by their label."""
    lines = [line for ax in figure.axes for line in ax.get_lines() if line.get_gid() == "measured"]
    return {line.get_label(): line.get_xydata().tolist() for line in lines}


def written(folder, text):
    (folder / "points.csv").write_text(text)
    return str(folder / "points.csv")


# the levels by the word of the drive in the file, and an empty one
POINTS = f"amplitude,omega,x\n1.5,{TURN!r},0.2\n4,{TURN!r},0.9\n2,{2 * TURN!r},0.3\n2,,0.4\n"


@pytest.mark.parametrize("words", [{}, {RATE: "omega"}])
def test_bifurcation__points_at_the_level_of_the_diagram_and_at_others(tmp_path, words):
    options = BifurcationOptions(points=written(tmp_path, POINTS), at={"frequency": 1.0})
    figure = bifurcation.draw(run_of(cube(**words)), options)
    assert measured(figure) == {
        "measured": [[1.5, 0.2], [4.0, 0.9]],
        "measured at other levels": [[2.0, 0.3], [2.0, 0.4]],
    }
    assert {"measured", "measured at other levels"} <= set(legend_texts(figure))
    assert figure.axes[0].get_xlim()[1] > 4.0
    assert figure.axes[0].get_ylim()[1] > 0.9
    assert figure.data["measured_parameter"].values.tolist() == [1.5, 4.0, 2.0, 2.0]
    assert figure.data["measured_x"].values.tolist() == [0.2, 0.9, 0.3, 0.4]


def test_bifurcation__ranges_of_the_user_stay(tmp_path):
    points = read_points(written(tmp_path, POINTS), load_model("duffing"), "amplitude", needed=("x",), known=())
    frame = Frame(xlim=(1.0, 2.0), ylim=(0.0, 0.5))
    figure = bifurcation.plot_bifurcation(cube(), at={"frequency": 1.0}, points=points, frame=frame)
    assert figure.axes[0].get_xlim() == (1.0, 2.0)
    assert figure.axes[0].get_ylim() == (0.0, 0.5)
    # without a level in the file all points are those of the figure
    assert list(measured(figure)) == ["measured"]


def test_bifurcation__an_angle_is_measured_in_degrees_and_drawn_from_minus_pi_to_pi(tmp_path):
    file = written(tmp_path, "period,psi1_deg\n0.5,350\n1,30\n")
    ds = cube(PENDULUM, STATES).isel(amplitude=0, drop=True)
    for degrees, low in ((False, np.radians(-10.0)), (True, -10.0)):
        figure = bifurcation.draw(run_of(ds), BifurcationOptions(points=file, degrees=degrees))
        (first, second) = measured(figure)["measured"]
        assert first == pytest.approx([2.0, low], rel=1e-12)
        assert second == pytest.approx([1.0, -3.0 * low], rel=1e-12)
        assert figure.axes[0].get_ylim()[0] < low


def branches_of(levels):
    """A straight branch of period 1 at each level of the force, over the frequency."""
    n = len(levels)
    section = np.broadcast_to(np.array(levels)[:, None, None, None], (n, 3, 1, 2)).copy()
    numbers = {"kind": np.int8, "of_branch": np.int32, "to_branch": np.int32, "origin": np.int32, "after": np.int32}
    numbers |= {"n_unstable_before": np.int8, "n_unstable_after": np.int8, "bifurcation_side": np.int8}
    return xr.Dataset(
        {
            "parameter": (("branch", "point"), np.broadcast_to([1.0, 1.5, 2.0], (n, 3)).copy(), {"units": "Hz"}),
            "section": (("branch", "point", "phase", "state"), section),
            "n_unstable": (("branch", "point"), np.zeros((n, 3), np.int8)),
            "n_points": ("branch", np.full(n, 3)),
            "orbit_period": ("branch", np.ones(n, np.int32)),
            **{f"{end}_end": ("branch", np.zeros(n, np.int8), {"flag_meanings": "bound"}) for end in ("first", "last")},
            "bifurcation_section": (("bifurcation", "phase", "state"), np.zeros((0, 1, 2))),
            "value": ("bifurcation", np.zeros(0)),
            **{name: ("bifurcation", np.zeros(0, dtype)) for name, dtype in numbers.items() if name != "origin"},
            "origin": ("branch", np.full(n, -1)),
        },
        coords={"state": ["x", "v"], "level": ("branch", levels, {"long_name": "value of amplitude", "units": "1"})},
        attrs={**DUFFING, "parameter": "frequency", "parameter_units": "Hz"},
    )


def test_branches__points_and_branches_are_those_of_the_level(tmp_path):
    """Before, branches of all levels were drawn over the diagram of one."""
    file = written(tmp_path, "x,period,amplitude\n0.9,1,1\n5,0.25,1\n2,1,3\n")
    run = run_of(cube(), branches_of([1.0, 3.0]))
    figure = branches.draw_branches(
        run, BranchFigureOptions(parameter="frequency_hz", points=file, at={"amplitude": 1.0})
    )
    assert figure.data["level"].values.tolist() == [1.0]
    assert measured(figure) == {"measured": [[1.0, 0.9], [4.0, 5.0]], "measured at other levels": [[1.0, 2.0]]}
    assert figure.axes[0].get_xlim()[1] > 4.0
    assert figure.axes[0].get_ylim()[1] > 5.0
    assert figure.data["measured_amplitude"].values.tolist() == [1.0, 1.0, 3.0]
    assert {"measured", "measured at other levels"} <= set(legend_texts(figure))


def test_by_level__colours_of_levels_and_black_for_the_rest():
    about = {"long_name": "F", "units": "1"}
    points = xr.Dataset({"parameter": ("measured", [1.0, 2.0, 3.0]), "F": ("measured", [1.0, 2.0, 3.0], about)})
    levels = {(("F", 1.0),): "red", (("F", 3.0),): "blue"}
    found = [(own.tolist(), look["markerfacecolor"], look["label"]) for own, look in by_level(points, levels)]
    assert found == [
        ([True, False, False], "red", "measured, F = 1"),
        ([False, False, True], "blue", "measured, F = 3"),
        ([False, True, False], "black", "measured at other levels"),
    ]
    # black curves: points at other levels are open
    found = [(own.tolist(), look["markerfacecolor"]) for own, look in by_level(points, {(("F", 1.0),): "black"})]
    assert found == [([True, False, False], "black"), ([False, True, True], "white")]


@pytest.mark.parametrize(
    ("text", "options", "named"),
    [
        ("omega,x\n1,2\n", {}, "no column amplitude; .* it has omega, x"),
        ("amplitude,x\n1,2\n", {"state": "v"}, "no column v; .* it has amplitude, x"),
        ("amplitude,x\n1,2\n1,two\n", {}, r"row 3, x = 'two'"),
    ],
)
def test_bifurcation__refuses_before_it_draws(tmp_path, text, options, named):
    file = written(tmp_path, text)
    with pytest.raises(SpecError, match=named) as refused:
        bifurcation.draw(run_of(cube()), BifurcationOptions(points=file, at={"frequency": 1.0}, **options))
    assert str(refused.value).startswith(file)
