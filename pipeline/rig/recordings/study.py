"""Recordings of virtual rigs as inputs of a study: pictures and measures of them."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import Field

from pipeline.layout.writing import write_atomically
from pipeline.report.estimates import Estimate, Options, Results
from pipeline.report.inputs import Input
from pipeline.report.pictures import Picture, PictureTable
from pipeline.specification.tables import Table

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.plots.style import DataFigure
    from pipeline.rig.virtual import Rig


class RecordingTable(Table):
    """Table ``[recordings.NAME]`` of a study's file: a recording of a simulated test rig."""

    rig: str = Field(description="Virtual rig: a file, relative to the study.")


def _read(table: RecordingTable, folder: Path) -> Rig:
    from pipeline.rig.virtual import load_rig

    return load_rig(folder / table.rig)


def _recorded(rig: Rig, place: Path) -> xr.Dataset:
    """Simulate a recording, write it with its mapping, and read it."""
    from pipeline.rig.recordings import read_recording
    from pipeline.rig.recordings.writing import write_raw
    from pipeline.rig.virtual import simulated

    raw, mapping = simulated(rig, is_csv=True)
    file = place.with_suffix(".csv")
    file.parent.mkdir(parents=True, exist_ok=True)
    write_raw(raw, file)
    write_atomically(place.with_suffix(".toml"), mapping.toml())
    return read_recording(file, mapping)


RECORDINGS = Input(RecordingTable, "Recordings of virtual rigs.", "recording of a virtual rig", _read, _recorded)


def _drawn(results: Results, table: PictureTable) -> DataFigure:
    from pipeline.plots.style import Frame
    from pipeline.rig.recordings.figure import plot_recording

    low, high = table.options.get("xlim", (None, None))
    return plot_recording(results.computed(table.of), frame=Frame(xlim=(low, high) if low is not None else None))


def _command(place: Path, table: PictureTable) -> str:
    file = place / "recordings" / f"{table.of}.csv"
    mapping, out = file.with_suffix(".toml"), file.with_suffix(".png")
    return f"magpend recordings show {shlex.quote(str(file))} --mapping {mapping} --out {out}"


def _series(results: Results, table: PictureTable) -> DataFigure:
    """Draw a recording beside the model's motion from the same state."""
    from pipeline.rig.measured.figures import plot_series
    from pipeline.rig.measured.series import series_of

    n_periods = int(table.options.get("periods", 10))
    parameters = results.read(table.of).parameters
    return plot_series(series_of(results.computed(table.of), parameters, n_periods=n_periods))


RECORDING = Picture("a recording", _drawn, _command)
SERIES = Picture("a recording, and with the model from the same state", _series)


def recorded_duty_cycle(results: Results, of: Sequence[str], options: Options) -> Estimate:
    """Return the duty cycle of a recorded drive, computed from the drive's switching edges."""
    from pipeline.rig.edges import edges_of

    timing = edges_of(results.computed(of[0])).frequency()
    half = 1.96 * timing.duty_cycle_error
    text = f"{timing.n_periods} periods at {timing.frequency_hz:.6g} Hz"
    return Estimate(timing.duty_cycle, timing.duty_cycle - half, timing.duty_cycle + half, text, n=timing.n_periods)
