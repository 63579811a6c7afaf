"""Figures of a cube: Dataset in, matplotlib Figure out.

Nothing here integrates, opens a store or touches pyplot: figures are plain objects, so they can be made
in any thread and without a display.
"""

from pipeline.plots.basins import plot_basins
from pipeline.plots.bifurcation import plot_bifurcation
from pipeline.plots.branches import plot_branches, plot_curves, plot_multipliers
from pipeline.plots.chaos import plot_convergence, plot_dimension
from pipeline.plots.coexisting import plot_coexisting
from pipeline.plots.fractions import plot_fractions
from pipeline.plots.gallery import plot_gallery
from pipeline.plots.lyapunov import plot_lyapunov, plot_lyapunov_map
from pipeline.plots.regimes import plot_regimes
from pipeline.plots.style import save_data, save_figure
from pipeline.plots.trajectory import plot_trajectory

__all__ = [
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
    "plot_multipliers",
    "plot_regimes",
    "plot_trajectory",
    "save_data",
    "save_figure",
]
