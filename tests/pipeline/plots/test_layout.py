"""Where things stand in a figure: nothing covers a label, and all of it is inside."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from magpend_core.models.pendulum.sides import Side
from pipeline.layout import vocabulary
from pipeline.layout.vocabulary import PERIODIC_ORBIT
from pipeline.plots import (
    Frame,
    plot_basins,
    plot_bifurcation,
    plot_branches,
    plot_coexisting,
    plot_fractions,
    plot_gallery,
    plot_trajectory,
)
from pipeline.plots.style import COLUMN_MM
from tests.pipeline.analysis.dense_sets import rows_of
from tests.pipeline.plots.made_up import DUFFING, PENDULUM, make_attractors, make_portraits
from tests.pipeline.plots.test_door import make_cube
from tests.pipeline.plots.test_trajectory import STATES, make_trajectory


def texts_of(fig):
    """Texts with their bounding boxes [pixels], labels of the ticks in view included."""
    canvas = FigureCanvasAgg(fig)
    canvas.draw()
    found = list(fig.texts)
    for ax in fig.axes:
        found += [*ax.texts, ax.xaxis.label, ax.yaxis.label]
        for axis in (ax.xaxis, ax.yaxis):
            low, high = sorted(axis.get_view_interval())
            ticks = zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=False)  # shared axes have no labels
            found += [label for place, label in ticks if low <= place <= high]
    return [(t, t.get_window_extent(canvas.get_renderer())) for t in found if t.get_text()]


def is_clear(fig):
    """Check that no text covers a panel or another text, and that all are inside and legible."""
    texts, panels = texts_of(fig), [ax.get_window_extent() for ax in fig.axes]
    for text, box in texts:
        assert not any(box.padded(-2).overlaps(p.padded(-2)) for p in panels if text.axes is None), text.get_text()
        assert -1.0 <= box.x0 < box.x1 <= fig.bbox.x1 + 1.0, text.get_text()
        assert -1.0 <= box.y0 < box.y1 <= fig.bbox.y1 + 1.0, text.get_text()
        assert text.get_fontsize() >= 6.0
    for (text, box), (other, place) in itertools.combinations(texts, 2):
        assert not box.padded(-2).overlaps(place.padded(-2)), (text.get_text(), other.get_text())
    for legend in fig.legends:
        box = legend.get_window_extent()
        assert 0 <= box.x0 < box.x1 <= fig.bbox.x1
        assert 0 <= box.y0 < box.y1 <= fig.bbox.y1


@pytest.mark.slow
@pytest.mark.parametrize("width", [COLUMN_MM, 120.0, 178.0])
def test_bifurcation__width_in_millimetres_and_legible_letters(width):
    figure = plot_bifurcation(make_cube(), frame=Frame(width))
    assert figure.get_size_inches()[0] * 25.4 == pytest.approx(width)
    is_clear(figure)
    assert min(text.get_fontsize() for text, _ in texts_of(figure)) >= 7.0
    assert len([tick for tick in figure.axes[0].get_xticks() if 2.0 <= tick <= 2.2]) > 2


@pytest.mark.slow
@pytest.mark.parametrize("width", [85.0, 178.0])
@pytest.mark.parametrize("n", [1, 2, 3])
def test_gallery__no_label_covers_a_panel_or_another_label(n, width):
    """Labels of paths, which have many digits, covered each other and the panel on the left."""
    portraits = make_portraits(n)
    portraits["orbit"] = 0.05 * portraits["orbit"] + 0.2
    figure = plot_gallery(rows_of(make_attractors(np.arange(n), ("initial_condition",))), portraits, frame=Frame(width))
    is_clear(figure)
    panels = [ax.get_window_extent() for ax in figure.axes]
    for text, box in texts_of(figure):
        assert not any(box.padded(-2).overlaps(p.padded(-2)) for p in panels), text.get_text()


@pytest.mark.slow
def test_trajectory__labels_stay_off_the_series():
    """The path of a small motion has ticks of many digits, known only once its scale is."""
    ds = make_trajectory()
    for state in STATES:
        ds[state] = 0.02 * ds[state] + (0.1 if state in ("psi1", "psi2") else 0.0)
    figure = plot_trajectory(ds.assign_attrs(PENDULUM))
    boxes = dict(texts_of(figure))
    (last,) = (ax for ax in figure.axes if ax.get_xlabel() == "time [s]")
    assert boxes[figure.axes[-1].yaxis.label].x0 > last.get_window_extent().x1


@pytest.mark.slow
def test_legends__fit_into_the_figure_beside_the_axes():
    """Twenty attractors with the longest names."""
    coords = {"frequency": [2.0, 2.1, 2.2]}
    ds = make_attractors(np.tile(np.arange(20), (3, 1)), ("frequency", "initial_condition"), coords)
    ds["orbit_period"][:] = np.array([11, 13, 0])[:, None]
    ds["kind"][:] = np.array([PERIODIC_ORBIT, PERIODIC_ORBIT, vocabulary.BOUNDED_SET])[:, None]
    ds["side"][:] = np.array([Side.LEFT, Side.RIGHT, Side.STRADDLING])[:, None]
    for figure in (plot_fractions(ds), plot_coexisting(ds)):
        is_clear(figure)
        assert figure.legends[0].get_window_extent().x0 > figure.axes[0].get_window_extent().x1
    axes = {name: np.linspace(-1.0, 1.0, 4) for name in ("psi1_0", "psi2_0")}
    square = make_attractors(np.arange(16).reshape(4, 4), tuple(axes), axes)
    square["orbit_period"][:] = 16
    square["side"][:] = Side.STRADDLING
    is_clear(plot_basins(square, n_periods=xr.ones_like(square["attractor_id"])))


def test_branches__names_cover_no_line():
    """Two branches cross the parameter closely; the names of their folds stand where no line is."""
    n = 41
    psi = np.linspace(1.0, -1.0, n)
    section = np.zeros((2, n, 1, 2))
    section[:, :, 0, 0] = psi, psi + 0.1
    events = {"kind": [0, 0], "value": [0.3, 0.3], "of_branch": [0, 1], "after": [20, 20]}
    events |= {"n_unstable_before": [0, 0], "n_unstable_after": [1, 1]}
    ds = xr.Dataset(
        {
            "parameter": (("branch", "point"), np.stack([0.3 - 0.05 * psi**2] * 2)),
            "section": (("branch", "point", "phase", "state"), section),
            "n_unstable": (("branch", "point"), np.stack([(psi < 0)] * 2).astype(np.int8)),
            "n_points": ("branch", [n, n]),
            "orbit_period": ("branch", [1, 1]),
            "bifurcation_section": (("bifurcation", "phase", "state"), np.array([[[0.0, 0.0]], [[0.1, 0.0]]])),
            **{name: ("bifurcation", values) for name, values in events.items()},
        },
        coords={"state": ["x", "v"]},
        attrs={**DUFFING, "parameter": "frequency_hz", "parameter_units": "Hz"},
    )
    ax = plot_branches(ds).axes[0]
    names = [t for t in ax.texts if t.get_text() == "F1"]
    assert names
    for text in names:
        text.get_window_extent()  # finds its place; what it returns also holds the line that leads to it
        box = Text.get_window_extent(text)
        for line in ax.get_lines():
            x, y = ax.transData.transform(np.asarray(line.get_xydata())).T
            assert not ((x > box.x0) & (x < box.x1) & (y > box.y0) & (y < box.y1)).any()
