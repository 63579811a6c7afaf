"""Describe the channels of a file, or the quantities of a recording, by tables."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr

from pipeline.layout.vocabulary import model_of
from pipeline.products.product import Table
from pipeline.results.tabular import aligned, number
from pipeline.rig.recordings.channels import Raw, findings_of, summary
from pipeline.rig.recordings.clock import step_of
from pipeline.rig.recordings.mapping import DRIVE


def describe_file(raw: Raw) -> Table:
    """Return a table with one row for each channel of a file, before any mapping to quantities."""
    rows = [_channel_row(raw, name) for name in raw.names]
    head = f"{raw.path.name}: {raw.format}, {len(raw.names)} channels"
    if len(raw.stretches) > 1:
        head += f" in {len(raw.stretches)} stretches"
    lines = [head + (", simulated" if raw.simulated else "")]
    words = [
        {
            "channel": row["channel"],
            "samples": f"{row['samples']} ({row['no_numbers']} are none)" if row["no_numbers"] else str(row["samples"]),
            "rate [Hz]": number(row["sampling_rate_hz"], ".6g"),
            "start [s]": number(row["start_s"], ".6g"),
            "unit": row["unit"] or "-",
            "least": number(row["least"], ".6g"),
            "greatest": number(row["greatest"], ".6g"),
        }
        for row in rows
    ]
    lines += aligned(words, "", right=True)
    lines += [f"{f.severity}: {f.channel}{': ' if f.channel else ''}{f.text}" for f in raw.findings]
    return Table(rows, lines)


def _channel_row(raw: Raw, name: str) -> dict[str, Any]:
    own = [stretch[name] for stretch in raw.stretches if name in stretch]
    values = np.concatenate([c.values for c in own])
    known = values[np.isfinite(values)]
    step = step_of(own[0])
    start = float(own[0].time[0]) if own[0].time is not None and len(own[0]) else own[0].start_s
    return {
        "channel": name,
        "stretches": len(own),
        "samples": len(values),
        "sampling_rate_hz": 1.0 / step if step > 0.0 else math.nan,
        "start_s": start,
        "unit": own[0].unit,
        "least": float(known.min()) if known.size else math.nan,
        "greatest": float(known.max()) if known.size else math.nan,
        "no_numbers": len(values) - int(known.size),
    }


def describe_recording(ds: xr.Dataset) -> tuple[Table, Table]:
    """Return tables of a recording: a row per measured quantity, with its noise, and a row per finding."""
    from pipeline.rig.recordings.smoothing import smooth

    smoothed = smooth(ds)
    rows = [_quantity_row(ds, smoothed, str(name)) for name in ds.data_vars]
    time, piece = ds["time"].values, ds["piece"].values
    n_pieces = len(np.unique(piece))
    lines = [
        f"{ds.attrs['file']}: {ds.attrs['format']}, {len(time)} samples at "
        f"{ds.attrs['sampling_rate_hz']:.8g} Hz, {time[-1] - time[0]:.6g} s in {n_pieces} "
        f"piece{'s' if n_pieces > 1 else ''}, model {model_of(ds).name}"
        + (", simulated" if ds.attrs.get("simulated") else "")
    ]
    words = [
        {
            "quantity": row["quantity"],
            "unit": row["unit"],
            "least": number(row["least"], ".6g"),
            "greatest": number(row["greatest"], ".6g"),
            "not measured": str(row["not_measured"]),
            "noise": number(row["noise"], ".6g"),
            "window [s]": number(row["window_s"], ".6g"),
        }
        for row in rows
    ]
    lines += aligned(words, "", right=True)
    findings = findings_of(ds)
    return Table(rows, lines), Table([asdict(f) for f in findings], summary(findings) or ["findings: none"])


def _quantity_row(ds: xr.Dataset, smoothed: xr.Dataset, name: str) -> dict[str, Any]:
    values = ds[name].values
    known = values[np.isfinite(values)]
    attrs = smoothed[name].attrs if name != DRIVE else {}
    return {
        "quantity": name,
        "unit": str(ds[name].attrs["units"]),
        "least": float(known.min()) if known.size else math.nan,
        "greatest": float(known.max()) if known.size else math.nan,
        "not_measured": len(values) - int(known.size),
        "noise": float(attrs.get("noise", math.nan)),
        "window_s": float(attrs.get("window_s", math.nan)),
    }
