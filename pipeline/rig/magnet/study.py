"""Fits of torque curves as inputs of a study: pictures and measures of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from pipeline.report.estimates import Estimate, Options, Results
from pipeline.report.inputs import Input
from pipeline.report.pictures import Picture, PictureTable
from pipeline.specification.problems import SpecError, unknown_name
from pipeline.specification.tables import Table

if TYPE_CHECKING:
    from pipeline.plots.style import DataFigure
    from pipeline.rig.magnet.fitting import Outcome
    from pipeline.rig.magnet.measurement import Measurement

_DRAWS, _SEED = 2000, 2018


class TorqueTable(Table):
    """Table ``[torques.NAME]`` of a study's file: torque readings to fit."""

    header: str = Field(description="Header of torque readings: a file, or the name of one that ships.")


def _read(table: TorqueTable, folder: Path) -> Measurement:
    """Read torque readings, given by the path of their header file or by the name of a shipped measurement."""
    from pipeline.rig.magnet.measurement import find_measurement, read_measurement

    own = folder / table.header
    return read_measurement(find_measurement(str(own) if own.is_file() else table.header))


def _fitted(readings: Measurement, place: Path) -> Outcome:
    from pipeline.rig.magnet.fitting import fit_measurement

    return fit_measurement(readings)


TORQUES = Input(TorqueTable, "Torque readings that are fitted.", "fit of torque readings", _read, _fitted)


def _drawn(results: Results, table: PictureTable) -> DataFigure:
    """Draw a named figure of torque readings from `pipeline.rig.magnet.figures.FIGURES`."""
    from pipeline.rig.magnet.figures import FIGURES

    if table.figure not in FIGURES:
        raise SpecError(unknown_name("figure of torque readings", table.figure, FIGURES))
    return FIGURES[table.figure](results.computed(table.of))


FIT = Picture("a figure of a fit of torque readings", _drawn)


def curves_described(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the fraction of torque curves whose single-curve fit reaches a coefficient of determination of ``r2``."""
    outcome: Outcome = results.computed(of[0])
    from pipeline.results.intervals import binomial_interval

    r2 = np.array([fit.quality.r2 for fit in outcome.curves])
    count = int((r2 >= options["r2"]).sum())
    low, high = binomial_interval(count, r2.size, method="clopper-pearson")
    text = f"{count} of {r2.size} curves; R2 {r2.min():.3f} to {r2.max():.3f}, median {np.median(r2):.3f}"
    return Estimate(count / r2.size, float(low), float(high), text, n=int(r2.size))


def gain_over_dipoles(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the relative reduction of squared residuals by the joint fit, compared with the fit of point dipoles.

    The interval is a bootstrap over whole curves, so residuals within a curve may be correlated.
    """
    outcome: Outcome = results.computed(of[0])
    own, other = (_squares(outcome, r) for r in (outcome.joint.residuals, outcome.dipoles.residuals))
    rng = np.random.default_rng(_SEED)
    drawn = rng.integers(0, own.size, (_DRAWS, own.size))
    gains = 1.0 - own[drawn].sum(1) / other[drawn].sum(1)
    low, high = np.quantile(gains, [0.025, 0.975])
    q, d = outcome.joint.quality, outcome.dipoles.quality
    text = f"R2 {q.r2:.4f} (rms {q.rms * 1e3:.0f} mN m) against {d.r2:.3f} (rms {d.rms * 1e3:.0f} mN m)"
    return Estimate(float(1 - own.sum() / other.sum()), float(low), float(high), text, n=own.size)


def _squares(outcome: Outcome, residuals: np.ndarray) -> np.ndarray:
    return np.array([float((residuals[fit.curve.rows] ** 2).sum()) for fit in outcome.curves])


def width_spread(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the variation of the torque peaks' width with the locked angle, relative to the mean width.

    A parabola in the locked angle is fitted to the widths. Its range over the measured angles is divided by
    its mean. The interval is a bootstrap over the curves.
    """
    outcome: Outcome = results.computed(of[0])
    width = np.array([_width(fit.values) for fit in outcome.curves])
    locked = np.array([fit.curve.locked for fit in outcome.curves])
    rng = np.random.default_rng(_SEED)

    def spread(rows: np.ndarray) -> float:
        at = np.polyval(np.polyfit(locked[rows], width[rows], 2), np.unique(locked))
        return float((at.max() - at.min()) / at.mean())

    every = np.arange(width.size)
    draws = [spread(rng.choice(every, every.size)) for _ in range(_DRAWS // 4)]
    low, high = np.quantile(draws, [0.025, 0.975])
    least, most = np.degrees([width.min(), width.max()])
    text = f"widths {least:.2f} to {most:.2f} degrees over {width.size} curves"
    return Estimate(spread(every), float(low), float(high), text, n=width.size)


def _width(values: Mapping[str, float]) -> float:
    from magpend_core.models.pendulum import magnet_torque as laws

    return abs(float(values[laws.WIDTH]))


def signs_apart(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the fraction of readings in which torque and distance from the transition angle have the same sign."""
    outcome: Outcome = results.computed(of[0])
    from magpend_core.models.pendulum import magnet_torque as laws
    from pipeline.results.intervals import binomial_interval

    m = outcome.measured
    line = laws.transition(outcome.joint.values)
    beyond = m.angle - np.polyval(line, m.locked)
    clear = np.abs(m.torque) > options.get("clear", 0.0)
    same = (np.sign(m.torque) == np.sign(beyond))[clear]
    low, high = binomial_interval(int(same.sum()), same.size, method="clopper-pearson")
    text = f"{same.sum()} of {same.size} readings that are clear of the noise"
    return Estimate(float(same.mean()), float(low), float(high), text, n=len(outcome.curves))
