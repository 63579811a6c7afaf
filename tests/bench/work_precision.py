"""Work-precision figure: error at the section against CPU time per drive period.

Run from the repository's root::

    python tests/bench/work_precision.py [--out work_precision.png] [options of peers.py]

The kernel at rtol = atol = 1e-3 ... 1e-11 beside heyoka, numbalsoda and scipy (`peers` says how each
is run), one panel for each steepness of the drive's edges. Solvers that are not installed are left
out. Filled markers lie on the solver's front; the others are beaten by another setting of the same
solver.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter
from peers import build_problem, checked_options, describe, enter_all, parser, race, table
from problem import Curve, Problem

# Okabe and Ito's colours, which colour-blind readers can tell apart; marker and dash say it again.
LOOKS: dict[str, dict[str, Any]] = {
    "magpend": {"color": "#D55E00", "marker": "o", "linestyle": "-", "linewidth": 2.0, "zorder": 5},
    "heyoka": {"color": "#0072B2", "marker": "s", "linestyle": "-"},
    "numbalsoda LSODA": {"color": "#009E73", "marker": "^", "linestyle": "--"},
    "numbalsoda DOP853": {"color": "#CC79A7", "marker": "D", "linestyle": "--"},
    "scipy DOP853": {"color": "#000000", "marker": "v", "linestyle": ":"},
    "scipy RK45": {"color": "#7F7F7F", "marker": "x", "linestyle": ":"},
}
STYLE = {
    "font.size": 9,
    "axes.labelsize": 10,
    "axes.linewidth": 0.8,
    "legend.fontsize": 8.5,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "xtick.top": True,
    "ytick.right": True,
    "savefig.dpi": 300,
}


def draw_curve(axes: Any, curve: Curve) -> None:
    """Line through the front of a solver, its other settings as faint markers."""
    look = {"markersize": 4.5, "linewidth": 1.3, **LOOKS[curve.name]}
    error, cost = curve.front()
    axes.plot(error, cost, label=curve.name, **look)
    beaten = ~np.isin(curve.cost, cost)
    faint = {**look, "linestyle": "none", "alpha": 0.25, "zorder": 1}
    axes.plot(np.array(curve.error)[beaten], np.array(curve.cost)[beaten], **faint)


def draw_panel(axes: Any, problem: Problem, curves: list[Curve], letter: str) -> None:
    """One drive."""
    for curve in curves:
        draw_curve(axes, curve)
    axes.set(xscale="log", yscale="log", xlim=(3e-3, 1.3e-11))
    axes.xaxis.set_major_locator(LogLocator(numticks=12))
    axes.xaxis.set_minor_locator(LogLocator(numticks=12))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    steepness = rf"$\varepsilon_\mathrm{{drive}} = {problem.parameters['eps_drive']:g}$"
    axes.set_title(f"({letter})  {steepness}, {problem.frequency_hz[0]:g} Hz", loc="left", fontsize=10)
    n_periods = problem.reference.shape[1]
    axes.set_xlabel(f"median scaled error after {n_periods} periods")


def draw(results: list[tuple[Problem, list[Curve]]], path: Path) -> None:
    """Write the figure."""
    with plt.rc_context(STYLE):
        n = len(results)
        figure, row = plt.subplots(1, n, figsize=(3.6 * n + 0.2, 3.9), sharey=True, squeeze=False, layout="constrained")
        for axes, (problem, curves), letter in zip(row[0], results, "abcdefgh", strict=False):
            draw_panel(axes, problem, curves, letter)
        row[0][0].set_ylabel("CPU time per period and trajectory [\N{MICRO SIGN}s]")
        handles, labels = row[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(3, len(labels)), frameon=False)
        figure.savefig(path)
        plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    """Measure, print the tables and write the figure."""
    p = parser()
    p.description = __doc__
    p.add_argument("--out", type=Path, default=Path("work_precision.png"), help="PNG, PDF or SVG")
    options = checked_options(arguments, p)
    results = []
    for eps_drive in options.eps_drive:
        problem = build_problem(options, eps_drive)
        results.append((problem, race(enter_all(problem, options), problem)))
        print(f"{describe(problem)}\n{table(results[-1][1])}\n", flush=True)
    draw(results, options.out)
    print(options.out)


if __name__ == "__main__":
    main()
