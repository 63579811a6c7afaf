"""Describe a file or a recording by tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from pipeline.layout.vocabulary import model_of
from pipeline.products.product import Table
from pipeline.rig.recordings.clock import step_of
from pipeline.rig.recordings.findings import Finding, findings_of, summary
from pipeline.rig.recordings.mapping import DRIVE
from pipeline.rig.recordings.raw import Raw


def describe_file(raw: Raw) -> Table:
    """Return a row for each channel of a file, before any mapping.

    Parameters
    ----------
    raw
        Channels of the file.
    """
    rows = [_channel_row(raw, name) for name in raw.names]
    head = f"{raw.path.name}: {raw.format}, {len(raw.names)} channels"
    if len(raw.stretches) > 1:
        head += f" in {len(raw.stretches)} stretches"
    lines = [head + (", simulated" if raw.simulated else "")]
    lines += _aligned(
        ("channel", "samples", "rate [Hz]", "start [s]", "unit", "least", "greatest"),
        [
            (
                row["channel"],
                _counted(row),
                _number(row["sampling_rate_hz"]),
                _number(row["start_s"]),
                row["unit"] or "-",
                _number(row["least"]),
                _number(row["greatest"]),
            )
            for row in rows
        ],
    )
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


def _counted(row: dict[str, Any]) -> str:
    n = f"{row['samples']}"
    return f"{n} ({row['no_numbers']} are none)" if row["no_numbers"] else n


def describe_recording(ds: xr.Dataset) -> tuple[Table, Table]:
    """Return a row for each quantity of a recording, and one for each finding.

    Parameters
    ----------
    ds
        Recording from `read_recording`. The noise in the first table is from `smooth`.

    Returns
    -------
    Table, Table
        Quantities, and findings. Each finding has its own row; printed lines group them by kind and channel.
    """
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
    lines += _aligned(
        ("quantity", "unit", "least", "greatest", "not measured", "noise", "window [s]"),
        [
            (
                row["quantity"],
                row["unit"],
                _number(row["least"]),
                _number(row["greatest"]),
                str(row["not_measured"]),
                _number(row["noise"]),
                _number(row["window_s"]),
            )
            for row in rows
        ],
    )
    return Table(rows, lines), _findings_table(findings_of(ds))


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


def _findings_table(findings: Sequence[Finding]) -> Table:
    rows = [
        {
            "kind": f.kind,
            "channel": f.channel,
            "start_s": f.start_s,
            "end_s": f.end_s,
            "severity": f.severity,
            "text": f.text,
        }
        for f in findings
    ]
    lines = summary(findings)
    return Table(rows, lines or ["findings: none"])


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.6g}"


def _aligned(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table: first column left-aligned, others right-aligned."""
    table = [list(head), *(list(row) for row in rows)]
    widths = [max(len(row[j]) for row in table) for j in range(len(head))]
    return [
        "  ".join([row[0].ljust(widths[0]), *(t.rjust(w) for t, w in zip(row[1:], widths[1:], strict=True))])
        for row in table
    ]
