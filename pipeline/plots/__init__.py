"""Draw figures of a run's results: from an xarray Dataset to a matplotlib Figure.

No module here opens a store or uses pyplot. Figures are plain objects, so any thread can make them, and no
display is needed. `draw_figure` draws any figure of a run by name. `Frame` holds the size of a figure and the
ranges of its axes.
"""

from pipeline.plots.bifurcation import plot_bifurcation
from pipeline.plots.figure import draw_figure, save_data, save_figure
from pipeline.plots.section import plot_section
from pipeline.plots.style import DataFigure, Frame
from pipeline.plots.trajectory import plot_trajectory

__all__ = [
    "DataFigure",
    "Frame",
    "draw_figure",
    "plot_bifurcation",
    "plot_section",
    "plot_trajectory",
    "save_data",
    "save_figure",
]
