"""Where things stand in a figure: nothing covers a label, and all of it is inside."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg

from magpend_core.models.pendulum.sides import Side
from pipeline.analysis.attractors.figure import plot_gallery
from pipeline.analysis.basins.figure import plot_basins
from pipeline.analysis.basins.fractions_figure import plot_coexisting, plot_fractions
from pipeline.layout import vocabulary
from pipeline.layout.vocabulary import PERIODIC_ORBIT
from pipeline.plots import Frame, plot_bifurcation
from pipeline.plots.style import COLUMN_MM
from tests.pipeline.analysis.dense_sets import rows_of
from tests.pipeline.plots.made_up import make_attractors, make_portraits
from tests.pipeline.plots.test_door import make_cube


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


def crowded():
    """Twenty attractors with the longest names, over an axis and on a grid."""
    coords = {"frequency": [2.0, 2.1, 2.2]}
    ds = make_attractors(np.tile(np.arange(20), (3, 1)), ("frequency", "initial_condition"), coords)
    ds["orbit_period"][:] = np.array([11, 13, 0])[:, None]
    ds["kind"][:] = np.array([PERIODIC_ORBIT, PERIODIC_ORBIT, vocabulary.BOUNDED_SET])[:, None]
    ds["side"][:] = np.array([Side.LEFT, Side.RIGHT, Side.STRADDLING])[:, None]
    axes = {name: np.linspace(-1.0, 1.0, 4) for name in ("psi1_0", "psi2_0")}
    square = make_attractors(np.arange(16).reshape(4, 4), tuple(axes), axes)
    square["orbit_period"][:] = 16
    square["side"][:] = Side.STRADDLING
    return ds, square


def small_gallery(n, frame):
    """Portraits with ticks of many digits, which covered each other and the panel on the left."""
    portraits = make_portraits(n)
    portraits["orbit"] = 0.05 * portraits["orbit"] + 0.2
    return plot_gallery(rows_of(make_attractors(np.arange(n), ("initial_condition",))), portraits, frame=frame)


FIGURES = {
    "bifurcation": lambda frame: plot_bifurcation(make_cube(), frame=frame),
    "gallery of 1": lambda frame: small_gallery(1, frame),
    "gallery of 3": lambda frame: small_gallery(3, frame),
    "fractions": lambda frame: plot_fractions(crowded()[0], frame=frame),
    "coexisting": lambda frame: plot_coexisting(crowded()[0], frame=frame),
    "basins": lambda frame: plot_basins(
        crowded()[1], n_periods=xr.ones_like(crowded()[1]["attractor_id"]), frame=frame
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_figures__labels_are_inside_and_cover_nothing(name):
    for width in (COLUMN_MM, 178.0) if name in ("bifurcation", "gallery of 3") else (178.0,):
        figure = FIGURES[name](Frame(width))
        assert figure.get_size_inches()[0] * 25.4 == pytest.approx(width)
        is_clear(figure)
