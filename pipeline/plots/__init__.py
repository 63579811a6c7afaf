"""Draw figures of a run's results: from an xarray Dataset to a matplotlib Figure.

No module here opens a store or uses pyplot. Figures are plain objects, so any thread can make them, and no
display is needed. `draw_figure` draws any figure of a run by name. `Frame` holds the size of a figure and the
ranges of its axes.
"""

from pipeline.plots.basins import plot_basins, plot_manifolds
from pipeline.plots.bifurcation import plot_bifurcation
from pipeline.plots.branches import plot_branches, plot_multipliers
from pipeline.plots.convergence import plot_convergence
from pipeline.plots.dimension import plot_dimension
from pipeline.plots.figure import draw_figure, save_data, save_figure
from pipeline.plots.fractions import plot_coexisting, plot_fractions
from pipeline.plots.gallery import plot_gallery
from pipeline.plots.lyapunov import plot_lyapunov, plot_lyapunov_map
from pipeline.plots.regimes import plot_curves, plot_regimes
from pipeline.plots.section import plot_section
from pipeline.plots.style import DataFigure, Frame
from pipeline.plots.trajectory import plot_trajectory

__all__ = [
    "DataFigure",
    "Frame",
    "draw_figure",
    "plot_basins",
    "plot_bifurcation",
    "plot_branches",
    "plot_coexisting",
    "plot_convergence",
    "plot_curves",
    "plot_dimension",
    "plot_fractions",
    "plot_gallery",
    "plot_lyapunov",
    "plot_lyapunov_map",
    "plot_manifolds",
    "plot_multipliers",
    "plot_regimes",
    "plot_section",
    "plot_trajectory",
    "save_data",
    "save_figure",
]
