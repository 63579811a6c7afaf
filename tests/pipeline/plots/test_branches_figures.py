"""Figures of branches and their command line, from made-up datasets and a small run."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from matplotlib.lines import Line2D

from pipeline.plots import plot_branches, plot_multipliers
from tests.pipeline.plots.made_up import STATES


@pytest.fixture
def made_up():
    """A branch that folds at 3 Hz: stable going there, unstable coming back; psi1 = +-sqrt(3 - f)."""
    psi = np.linspace(1.0, -1.0, 21) + 0.02
    frequency = 3.0 - psi**2
    n = len(psi)
    section = np.zeros((1, n, 1, 4))
    section[0, :, 0, 0] = psi
    multipliers = np.stack([1.0 - psi, 0.5 + 0 * psi, 0.2 + 0.1j + 0 * psi, 0.2 - 0.1j + 0 * psi], axis=1)[None]
    after = int(np.flatnonzero(psi > 0)[-1])
    event = {
        "kind": 0,
        "value": 3.0,
        "of_branch": 0,
        "after": after,
        "n_unstable_before": 0,
        "n_unstable_after": 1,
        "critical_real": 1.0,
        "critical_imag": 0.0,
        "bifurcation_side": 2,
    }
    return xr.Dataset(
        {
            "parameter": (("branch", "point"), frequency[None]),
            "section": (("branch", "point", "phase", "state"), section),
            "multiplier_real": (("branch", "point", "multiplier"), multipliers.real),
            "multiplier_imag": (("branch", "point", "multiplier"), multipliers.imag),
            "n_unstable": (("branch", "point"), (psi < 0)[None].astype(np.int8)),
            "n_points": ("branch", [n]),
            "orbit_period": ("branch", [1]),
            "bifurcation_section": (("bifurcation", "phase", "state"), np.zeros((1, 1, 4))),
            **{name: ("bifurcation", [value]) for name, value in event.items()},
        },
        coords={"state": STATES},
        attrs={"parameter": "frequency_hz", "parameter_units": "Hz"},
    )


def branch_lines(figure):
    """Lines of branches: not single markers."""
    return [line for line in figure.axes[0].lines if isinstance(line, Line2D) and len(line.get_xdata()) > 1]


def test_plot_branches__solid_and_dashed(made_up):
    figure = plot_branches(made_up)
    solid, dashed = sorted(branch_lines(figure), key=lambda line: line.get_linestyle() != "-")
    assert solid.get_linestyle() == "-"
    assert dashed.get_linestyle() == "--"
    assert (np.asarray(solid.get_ydata()) >= 0.0).all()
    assert (np.asarray(dashed.get_ydata()) <= 0.0).all()
    # both go up to the fold itself
    assert np.max(solid.get_xdata()) == np.max(dashed.get_xdata()) == 3.0
    assert [text.get_text() for text in figure.axes[0].texts] == ["F1"]
    assert not branch_lines(plot_branches(made_up, max_period=0))
    with pytest.raises(ValueError, match="unknown state"):
        plot_branches(made_up, state="psi3")


def test_plot_branches__cut_where_an_angle_wraps(made_up):
    made_up["section"][0, 10:, 0, 0] -= 2.0 * np.pi
    lines = branch_lines(plot_branches(made_up))
    steps = np.concatenate([np.abs(np.diff(np.asarray(line.get_ydata(), float))) for line in lines])
    assert np.nanmax(steps) < np.pi


def test_plot_multipliers__all_points(made_up):
    figure = plot_multipliers(made_up)
    (points,) = figure.axes[0].collections
    assert len(points.get_offsets()) == 84
    with pytest.raises(ValueError, match="branches 0 to 0"):
        plot_multipliers(made_up, 1)
