"""Figures of Lyapunov exponents: units at a fixed frequency, many cells, scales fair to both signs."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magpend_core.status import Status
from pipeline.plots import Frame, plot_convergence, plot_lyapunov, plot_lyapunov_map
from pipeline.plots.convergence import MOST_LINES
from tests.pipeline.plots.made_up import DUFFING, legend_texts

FREQUENCY = 0.25


def make_cube(n_cells=3, dims=(), sizes=(), exponents=(0.3, -0.4)):
    """Exponents of cells at a fixed frequency, a scalar coordinate as in cubes that sweep none."""
    shape = (*sizes, n_cells)
    names = (*dims, "initial_condition")
    blocks = np.zeros((*shape, 8, 2)) + np.array(exponents)
    blocks += 0.02 * np.random.default_rng(0).standard_normal(blocks.shape)
    return xr.Dataset(
        {
            "section": ((*names, "period_index", "state"), np.zeros((*shape, 2, 2))),
            "status": (names, np.full(shape, 2, np.int8)),
            "orbit_period": (names, np.zeros(shape, np.int16)),
            "lyapunov": ((*names, "exponent"), blocks.mean(-2)),
            "lyapunov_stderr": ((*names, "exponent"), np.full((*shape, 2), 0.01)),
            "lyapunov_blocks": ((*names, "block", "exponent"), blocks),
            "lyapunov_flag": (names, np.ones(shape, np.int8)),
            "divergence": (names, np.full(shape, -0.1)),
        },
        coords={
            "state": ["x", "v"],
            "exponent": [1, 2],
            "frequency": ((), FREQUENCY, {"units": "Hz"}),
            **{d: (d, np.arange(n, dtype=float), {"units": "1"}) for d, n in zip(dims, sizes, strict=True)},
        },
        attrs={**DUFFING, "lyapunov_n_periods": 64},
    )


@pytest.mark.slow
@pytest.mark.parametrize("per", ["s", "period"])
def test_plot_convergence__per_period_at_one_fixed_frequency(per):
    ds = make_cube()
    figure = plot_convergence(ds, per=per)
    factor = 1.0 if per == "s" else 1.0 / FREQUENCY
    np.testing.assert_allclose(figure.data["exponent_value"], ds["lyapunov"][:, 0] * factor)
    assert figure.axes[0].get_title(loc="left") == "$f$ = 0.25\N{NO-BREAK SPACE}Hz"


@pytest.mark.slow
def test_plot_convergence__many_cells_are_bands():
    many = plot_convergence(make_cube(10_000))
    few = plot_convergence(make_cube(MOST_LINES))
    assert len(few.axes[0].get_lines()) > MOST_LINES
    assert len(many.axes[0].get_lines()) < 5
    bands = [c for c in many.axes[0].collections if str(c.get_gid()).startswith("quantiles:running")]
    assert len(bands) == 2
    running = many.data["running"].values
    outer, inner = (c.get_paths()[0].vertices for c in bands)
    assert outer[:, 1].min() == pytest.approx(np.quantile(running, 0.05, axis=0).min())
    assert inner[:, 1].max() == pytest.approx(np.quantile(running, 0.75, axis=0).max())
    median = next(line for line in many.axes[0].get_lines() if line.get_gid() == "running:chaotic")
    np.testing.assert_allclose(median.get_ydata(), np.median(running, axis=0))
    # every stored exponent still has its point
    assert sum(len(line.get_xdata()) for line in many.axes[2].get_lines() if len(line.get_xdata()) > 2) == 10_000


def test_plot_lyapunov_map__says_that_it_shows_the_maximum_over_cells():
    ds = make_cube(3, ("F", "delta"), (4, 3))
    ds["lyapunov"][1, 1] = [[-0.2, -0.4], [0.5, -0.4], [0.1, -0.4]]
    figure = plot_lyapunov_map(ds)
    bar = figure.axes[1]
    assert "maximum over the cells" in bar.get_ylabel()
    assert float(figure.data["exponent_value"].sel(F=1.0, delta=1.0)) == 0.5
    (mesh,) = [c for c in figure.axes[0].collections if c.get_gid() == "map"]
    assert mesh.norm.vmin == -mesh.norm.vmax
    assert figure.axes[0].get_title(loc="left").startswith("$f$ = 0.25")


def test_plot_lyapunov__over_a_parameter_at_a_fixed_frequency():
    ds = make_cube(3, ("F",), (6,))
    figure = plot_lyapunov(ds, per="period", spectrum=True, frame=Frame(85.0, ylim=(-2.0, 2.0)))
    np.testing.assert_allclose(figure.data["exponent_value"], ds["lyapunov"] / FREQUENCY)
    assert figure.axes[1].get_ylim() == (-2.0, 2.0)
    assert figure.axes[0].get_ylabel() == "$x$ [m]"
    assert "x_diagram" in figure.data


def lose(ds, index, status):
    """Give a cell a status, and no section and no exponent."""
    ds["status"][index] = status
    for name in ("section", "lyapunov", "lyapunov_stderr", "lyapunov_blocks"):
        ds[name][index] = np.nan
    ds["lyapunov_flag"][index] = 0


def boxes(axes, gid):
    """Range of x of what has an identifier."""
    xs = [path.vertices[:, 0] for c in axes.collections if c.get_gid() == gid for path in c.get_paths()]
    return (min(map(np.min, xs)), max(map(np.max, xs))) if xs else None


@pytest.mark.slow
def test_plot_lyapunov__shows_where_cells_were_lost_and_why():
    """Cells that diverged were no more than a gap, and were called failed in the panel above."""
    ds = make_cube(2, ("F",), (6,))
    for cell in range(2):
        lose(ds, (4, cell), Status.DIVERGED)
    lose(ds, (5, 0), Status.STEP_LIMIT)
    ds["status"][0, 0] = Status.INFERRED  # has a section, and no exponent
    ds["lyapunov"][0, 0] = np.nan
    figure = plot_lyapunov(ds)
    labels = legend_texts(figure)
    assert labels[-3:] == ["diverged: 2 of 12 cells", "failed: 1 of 12 cells", "without exponent: 1 of 12 cells"]
    top, bottom, strip = figure.axes
    assert boxes(strip, "absent:diverged") == (3.5, 4.5)
    assert boxes(strip, "absent:without exponent") == (-0.5, 0.5)
    assert boxes(top, "blank") == boxes(bottom, "blank") == (3.5, 4.5)
    assert strip.get_xlabel() == "F"
    assert len(plot_lyapunov(make_cube(2, ("F",), (6,))).axes) == 2


@pytest.mark.slow
def test_left_out__figures_of_exponents_say_how_many_cells_and_why():
    ds = make_cube(3, ("F", "delta"), (4, 3))
    assert "left out" not in plot_lyapunov_map(ds).axes[0].get_title(loc="left")
    for cell in range(3):
        lose(ds, (1, 1, cell), Status.DIVERGED)
    lose(ds, (0, 0, 0), Status.STEP_UNDERFLOW)
    figure = plot_lyapunov_map(ds)
    assert figure.axes[0].get_title(loc="left").endswith("left out of 36 cells: 3 diverged, 1 failed")
    assert [t.get_text() for t in figure.legends[0].get_texts()] == ["no cell has an exponent"]
    at_point = plot_convergence(ds, at={"F": 0.0, "delta": 0.0})
    assert at_point.axes[0].get_title(loc="left").endswith("left out of 3 cells: 1 failed")
