"""Figures of Lyapunov exponents: units at a fixed frequency, many cells, cells that are left out."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magpend_core.status import Status
from pipeline.analysis.chaos.convergence_figure import MOST_LINES, plot_convergence
from pipeline.analysis.chaos.lyapunov_figure import plot_lyapunov, plot_lyapunov_map
from tests.pipeline.plots.made_up import DUFFING, caption_of, legend_texts

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
    line = plot_lyapunov(make_cube(3, ("F",), (6,)), per=per, spectrum=True)
    np.testing.assert_allclose(line.data["exponent_value"], make_cube(3, ("F",), (6,))["lyapunov"] * factor)
    assert caption_of(figure) == "$f$ = 0.25 Hz"


@pytest.mark.slow
def test_plot_convergence__many_cells_are_bands():
    many = plot_convergence(make_cube(10_000))
    assert len(plot_convergence(make_cube(MOST_LINES)).axes[0].get_lines()) > MOST_LINES
    assert len(many.axes[0].get_lines()) < 5
    assert many.data["running"].shape == (10_000, 8)


def test_plot_lyapunov_map__shows_the_maximum_over_cells():
    ds = make_cube(3, ("F", "delta"), (4, 3))
    ds["lyapunov"][1, 1] = [[-0.2, -0.4], [0.5, -0.4], [0.1, -0.4]]
    figure = plot_lyapunov_map(ds)
    assert "maximum over the cells" in figure.axes[1].get_ylabel()
    assert float(figure.data["exponent_value"].sel(F=1.0, delta=1.0)) == 0.5


def lose(ds, index, status):
    """Give a cell a status, and no section and no exponent."""
    ds["status"][index] = status
    for name in ("section", "lyapunov", "lyapunov_stderr", "lyapunov_blocks"):
        ds[name][index] = np.nan
    ds["lyapunov_flag"][index] = 0


@pytest.mark.slow
def test_figures__say_how_many_cells_were_lost_and_why():
    line, plane = make_cube(2, ("F",), (6,)), make_cube(3, ("F", "delta"), (4, 3))
    assert "left out" not in caption_of(plot_lyapunov_map(plane))
    for cell in range(2):
        lose(line, (4, cell), Status.DIVERGED)
    lose(line, (5, 0), Status.STEP_LIMIT)
    line["status"][0, 0] = Status.INFERRED  # has a section, and no exponent
    line["lyapunov"][0, 0] = np.nan
    labels = legend_texts(plot_lyapunov(line))
    assert labels[-3:] == ["diverged: 2 of 12 cells", "failed: 1 of 12 cells", "without exponent: 1 of 12 cells"]
    for cell in range(3):
        lose(plane, (1, 1, cell), Status.DIVERGED)
    lose(plane, (0, 0, 0), Status.STEP_UNDERFLOW)
    figure = plot_lyapunov_map(plane)
    assert caption_of(figure).endswith("left out of 36 cells: 3 diverged, 1 failed")
    assert legend_texts(figure) == ["no cell has an exponent"]
    at_point = plot_convergence(plane, at={"F": 0.0, "delta": 0.0})
    assert caption_of(at_point).endswith("left out of 3 cells: 1 failed")
