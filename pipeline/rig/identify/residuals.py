"""Arrange residuals for drawing: rms by piece, autocorrelation, mean against the channel's rate of change, and
histogram.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy import stats

from pipeline.rig.identify.statistics import LEVEL, pooled_autocorrelation

LONGEST_LAG = 1 / 3
"""Longest lag of the autocorrelation, as a fraction of the shortest piece."""

BINS = 30


@dataclass(frozen=True)
class Series:
    """Piece of a recording within a dataset of residuals: its indices, its range of samples, and the size of its
    residuals.
    """

    # index of the recording, and of the piece in it
    recording: int
    number: int
    held_out: bool
    samples: tuple[int, int]  # first sample, and one past the last
    worst: float  # mean square of its residuals, each channel relative to its mean square over all pieces

    def of(self, ds: xr.Dataset) -> xr.Dataset:
        """Return the samples of this piece from the dataset of residuals."""
        return ds.isel(sample=slice(*self.samples))


def pieces_in(ds: xr.Dataset) -> list[Series]:
    """Return the pieces of a dataset of residuals in their order, each with its range of samples."""
    keys = np.stack([ds[name].values for name in ("held_out", "recording", "piece")])
    cuts = np.flatnonzero((np.diff(keys, axis=1) != 0).any(axis=0)) + 1
    bounds = [0, *cuts.tolist(), keys.shape[1]]
    channels = str(ds.attrs["channels"]).split()
    squares = np.stack([ds[f"{c}_residual"].values ** 2 for c in channels])
    squares = squares / np.nanmean(squares, axis=1, keepdims=True)
    return [
        Series(int(keys[1, a]), int(keys[2, a]), bool(keys[0, a]), (a, b), float(np.nanmean(squares[:, a:b])))
        for a, b in itertools.pairwise(bounds)
    ]


def per_piece(ds: xr.Dataset, channel: str) -> xr.Dataset:
    """Return the rms of a channel's residuals by piece, in the order of recordings and pieces."""
    pieces = sorted(pieces_in(ds), key=lambda s: (s.recording, s.number))
    residual = ds[f"{channel}_residual"].values
    rms = [float(np.sqrt(np.nanmean(residual[slice(*s.samples)] ** 2))) for s in pieces]
    return xr.Dataset(
        {"rms": ("number", np.array(rms))},
        coords={
            "piece": ("number", [s.number for s in pieces]),
            "recording": ("number", [s.recording for s in pieces]),
            "held_out": ("number", [int(s.held_out) for s in pieces]),
        },
    )


def rate_of(ds: xr.Dataset, channel: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a channel's computed rates of change and its residuals at the same times, over all fitted pieces.

    Computed values have no noise, so the rates are differences of neighbours.
    """
    rates, left = [], []
    for series in pieces_in(ds):
        if series.held_out:
            continue
        own = series.of(ds)
        residual = own[f"{channel}_residual"].values
        computed = own[f"{channel}_measured"].values - residual
        rates.append(np.gradient(computed, own["time"].values))
        left.append(residual)
    rate, residual = np.concatenate(rates), np.concatenate(left)
    known = np.isfinite(rate) & np.isfinite(residual)
    return rate[known], residual[known]


def residual_views(ds: xr.Dataset, channels: list[str]) -> xr.Dataset:
    """Return the data of the residual plots: autocorrelation, mean residual against the channel's rate of change,
    density, and rms by piece.

    Parameters
    ----------
    ds
        See `pipeline.rig.identify.reports.residuals_of`.
    channels
        Their names.
    """
    fitted = [s.of(ds) for s in pieces_in(ds) if not s.held_out]
    step = float(np.median(np.diff(fitted[0]["time"].values)))
    most = max(2, int(LONGEST_LAG * min(p.sizes["sample"] for p in fitted)))
    views = xr.Dataset(coords={"lag": ("lag", step * np.arange(most + 1), {"units": "s"})})
    for channel in channels:
        parts = [p[f"{channel}_residual"].values for p in fitted]
        unit = str(ds[f"{channel}_residual"].attrs.get("units", ""))
        n = sum(int(np.isfinite(r).sum()) for r in parts)
        band = float(stats.norm.ppf(0.5 + LEVEL / 2) / np.sqrt(n))
        rho = pooled_autocorrelation(parts, most)
        views[f"{channel}_autocorrelation"] = ("lag", rho, {"band": band, "units": "1"})
        rate, residual = rate_of(ds, channel)
        order = np.argsort(rate, kind="stable")
        bins = np.array_split(order, min(BINS, max(1, len(order) // 5)))
        dim = f"{channel}_bin"
        views[f"{channel}_rate"] = (dim, np.array([rate[b].mean() for b in bins]), {"units": f"{unit}/s"})
        views[f"{channel}_mean"] = (dim, np.array([residual[b].mean() for b in bins]), {"units": unit})
        width = float(residual.std())
        density, edges = np.histogram(residual, bins=61, range=(-4 * width, 4 * width), density=True)
        views[f"{channel}_edges"] = (f"{channel}_edge", edges, {"units": unit})
        views[f"{channel}_density"] = (f"{channel}_box", density, {"width": width})
        rms = per_piece(ds, channel)["rms"].values
        views[f"{channel}_rms"] = ("piece_number", rms, {"units": unit})
    return views
