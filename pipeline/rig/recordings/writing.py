"""Write recordings as files for other programs: TDMS, CSV, NetCDF."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

from pipeline.layout.vocabulary import model_of
from pipeline.layout.writing import write_atomically, write_netcdf
from pipeline.rig.recordings.channels import Channel, Raw
from pipeline.rig.recordings.delimited import SIMULATED as SIMULATED_LINE
from pipeline.rig.recordings.mapping import DRIVE, ChannelMap, DriveMap, Mapping, PieceMap, TimeMap
from pipeline.rig.recordings.tdms import SIMULATED
from pipeline.specification.files import check_new_file
from pipeline.specification.models import kept_reference
from pipeline.specification.problems import import_extra

SUFFIXES = (".tdms", ".csv", ".nc")
GROUP = "recording"
"""Group of the channels in a TDMS file."""


def write_recording(ds: xr.Dataset, path: str | Path) -> Path:
    """Write a recording in SI units to a TDMS, CSV or NetCDF file.

    Parameters
    ----------
    ds
        A recording.
    path
        ``.tdms`` or ``.csv``, which `read_recording` reads back to the same numbers with the mapping from
        `mapping_for`; or ``.nc``, the dataset itself as NetCDF.

    Raises
    ------
    SpecError
        If the suffix is another one, or the folder does not exist.
    """
    target = check_new_file(path, SUFFIXES)
    if target.suffix.lower() == ".nc":
        write_netcdf(target, ds)
        return target
    time, piece = ds["time"].values, ds["piece"].values
    step = 1.0 / float(ds.attrs["sampling_rate_hz"])
    channels = [Channel(str(n), v.values, str(v.attrs["units"]), 0.0, step) for n, v in ds.data_vars.items()]
    if not _is_one_waveform(ds):
        channels = [replace(c, start_s=math.nan, step_s=math.nan) for c in channels]
        channels += [Channel("time", time, "s"), Channel("piece", piece.astype(np.float64), "1")]
    is_simulated = bool(ds.attrs.get("simulated", 0))
    return write_raw(Raw(target, "", "", ({c.name: c for c in channels},), simulated=is_simulated), target)


def mapping_for(ds: xr.Dataset, path: str | Path) -> Mapping:
    """Return the mapping with which `read_recording` reads a file that `write_recording` wrote."""
    is_tdms = Path(path).suffix.lower() == ".tdms"

    def own(name: str) -> str:
        return f"{GROUP}/{name}" if is_tdms else name

    units = {str(n): str(v.attrs["units"]) for n, v in ds.data_vars.items()}
    with_time = not _is_one_waveform(ds) or not is_tdms
    kind = ds[DRIVE].attrs["kind"] if DRIVE in ds else None
    return Mapping(
        model=kept_reference(model_of(ds)),
        time=TimeMap(channel=own("time")) if with_time else None,
        piece=PieceMap(channel=own("piece")) if not _is_one_waveform(ds) else None,
        channels={n: ChannelMap(channel=own(n), unit=u) for n, u in units.items() if n != DRIVE},
        drive="none" if kind is None else DriveMap(channel=own(DRIVE), unit=units[DRIVE], kind=kind),
    )


def _is_one_waveform(ds: xr.Dataset) -> bool:
    """Return whether a recording is one piece from time 0, so that the sampling interval gives all times."""
    return ds["piece"].size == 0 or (int(ds["piece"][0]) == int(ds["piece"][-1]) and float(ds["time"][0]) == 0.0)


def write_raw(raw: Raw, path: str | Path) -> Path:
    """Write one stretch of channels of a file unchanged to a TDMS or CSV file.

    In a CSV file the sampling interval becomes a column ``time``. Raise `SpecError` if the suffix is another one, or
    the folder does not exist.
    """
    target = check_new_file(path, SUFFIXES[:2])
    (channels,) = raw.stretches
    write = _write_tdms if target.suffix.lower() == ".tdms" else _write_csv
    write(list(channels.values()), target, raw.simulated)
    return target


def _write_tdms(channels: Sequence[Channel], path: Path, is_simulated: bool) -> None:
    nptdms = import_extra("nptdms", "rig", str(path))
    objects = []
    for channel in channels:
        group, _, name = channel.name.rpartition("/")
        properties: dict[str, object] = {"unit_string": channel.unit} if channel.unit else {}
        if math.isfinite(channel.step_s):
            properties |= {
                "wf_increment": channel.step_s,
                "wf_start_offset": channel.start_s if math.isfinite(channel.start_s) else 0.0,
                "wf_samples": len(channel),
            }
        objects.append(nptdms.ChannelObject(group or GROUP, name, channel.values, properties))
    content = io.BytesIO()
    with nptdms.TdmsWriter(content) as writer:
        writer.write_segment([nptdms.RootObject({SIMULATED: 1} if is_simulated else {}), *objects])
    write_atomically(path, content.getvalue())


def _write_csv(channels: Sequence[Channel], path: Path, is_simulated: bool) -> None:
    columns = [(c.name, c.values) for c in channels]
    step = channels[0].step_s
    if not any(name == "time" for name, _ in columns) and math.isfinite(step):
        columns.insert(0, ("time", step * np.arange(len(channels[0]))))
    n = max(len(values) for _, values in columns)
    texts = [[repr(float(v)) if v == v else "" for v in values] + [""] * (n - len(values)) for _, values in columns]
    lines = [SIMULATED_LINE] if is_simulated else []
    lines.append(",".join(name for name, _ in columns))
    lines += map(",".join, zip(*texts, strict=True))
    write_atomically(path, "\n".join(lines) + "\n")
