"""Define ``magpend recordings``: show, convert and simulate recordings of an experiment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from pipeline.cli import console
from pipeline.cli.common import MAPPING, Csv, Json, json_rows, tell, tell_data
from pipeline.cli.groups import add_command, command_group
from pipeline.cli.options import drawing
from pipeline.cli.outputs import check_file, check_place
from pipeline.cli.plot import check_figure_path
from pipeline.layout.writing import write_atomically

if TYPE_CHECKING:
    import xarray as xr

    from pipeline.plots.style import DataFigure

File = Annotated[Path, typer.Argument(metavar="FILE", help="Recording: .tdms, .lvm, .csv or .mat.")]
Window = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="FROM TO", help="Part of the recording [s since its first sample]."),
]
Smooth = Annotated[bool, typer.Option("--smooth", help="Take smoothed states, and the rates from them.")]
SmoothingWindow = Annotated[float | None, typer.Option(help="Window of the smoothing [s]; by default the data choose.")]

recordings_app = command_group("Recordings of a rig: show a file's content and findings, convert it, simulate one.")


def show(
    file: File,
    mapping: Annotated[Path | None, typer.Option(metavar="MAP", help=MAPPING)] = None,
    window: Window = None,
    smooth: Smooth = False,
    smoothing_window: SmoothingWindow = None,
    out: Annotated[Path | None, typer.Option(help="Figure, .png, .pdf or .svg.")] = None,
    as_json: Json = None,
) -> None:
    """Describe a recording; with a mapping file, list the problems found in it and draw it.

    Without --mapping the command lists the channels of the file, which a mapping can name. With a mapping it
    reads them as states of the model, checks them, and with --out draws them. The exit code is 0 whatever the
    findings are.
    """
    from pipeline.rig.recordings.overview import describe_file
    from pipeline.rig.recordings.reading import read_raw
    from pipeline.specification.problems import SpecError

    if out is not None:
        check_figure_path(out)
    if mapping is None:
        if out is not None or window is not None or smooth:
            raise SpecError("--mapping: missing; the figure shows states, and a mapping assigns channels to them.")
        tell(describe_file(read_raw(file)), None, as_json)
        return
    ds = _read(file, mapping, window)
    _tell(ds, as_json)
    if out is not None:
        _draw(_smoothed(ds, smooth, smoothing_window), out, as_json)


def spectrum(
    file: File,
    mapping: Annotated[Path, typer.Option(metavar="MAP", help=MAPPING)],
    channel: Annotated[str, typer.Option(help="Measured quantity; by default the first.")] = "",
    window: Window = None,
    taper: Annotated[str, typer.Option(help="Window of each segment, by its name in scipy.signal.")] = "hann",
    nperseg: Annotated[
        int | None,
        typer.Option(min=4, help="Samples of a segment; by default a sixteenth of all, and more for a slow motion."),
    ] = None,
    scaling: Annotated[
        Literal["density", "spectrum"], typer.Option(help="Power per hertz, or power; as in scipy.signal.welch.")
    ] = "density",
    axis: Annotated[
        Literal["", "order", "Hz"], typer.Option(help="Frequencies as orders or in hertz; by default orders.")
    ] = "",
    out: Annotated[Path | None, typer.Option(help="Figure, .png, .pdf or .svg.")] = None,
    csv: Csv = None,
    as_json: Json = None,
) -> None:
    """Measure the spectrum of a recording, as scipy.signal.welch does; orders count from the drive's measured edges.

    Segments overlap by half, and those of all pieces are averaged. Gaps that interpolation can fill are filled; the
    notes say how many, and warn of segments that are too short for the slowest motion.
    """
    from pipeline.analysis.spectrum.analysis import spectrum_table
    from pipeline.rig.recordings.figure import spectrum_of_recording
    from pipeline.specification.problems import SpecError

    if out is not None:
        check_figure_path(out)
    try:
        found = spectrum_of_recording(
            _read(file, mapping, window), channel, window=taper, nperseg=nperseg, scaling=scaling
        )
        tell(spectrum_table(found), csv, as_json)
        if as_json or csv:
            console.note(*found.attrs["notes"].splitlines())
        if out is not None:
            from pipeline.analysis.spectrum.figure import plot_spectrum

            _save(plot_spectrum(found, axis=axis), out, as_json or csv)
    except ValueError as error:
        raise SpecError(f"{file}: {error}") from None


def analyse(
    file: File,
    mapping: Annotated[Path, typer.Option(metavar="MAP", help=MAPPING)],
    channel: Annotated[str, typer.Option(help="Measured quantity; by default the first.")] = "",
    window: Window = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the surrogates.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Figure, .png, .pdf or .svg.")] = None,
    csv: Csv = None,
    as_json: Json = None,
) -> None:
    """Measure period, largest exponent, dimension and recurrences of a recording, each with an interval.

    A result that noise or length forbid is not decided, and the table says why. The figure shows the delay portrait,
    the return map of the maxima, the divergence of neighbours, the correlation sums and the recurrences.
    """
    from pipeline.analysis.series.analysis import series_of, series_table
    from pipeline.specification.problems import SpecError

    if out is not None:
        check_figure_path(out)
    try:
        found = series_of(_read(file, mapping, window), channel, seed=seed)
    except ValueError as error:
        raise SpecError(f"{file}: {error}") from None
    tell(series_table(found), csv, as_json)
    if out is not None:
        from pipeline.analysis.series.figure import plot_series

        _save(plot_series(found), out, as_json or csv)


def convert(
    file: File,
    out: Annotated[Path, typer.Option(help="File to write: .tdms, .csv or .nc.")],
    mapping: Annotated[Path, typer.Option(metavar="MAP", help=MAPPING)],
    window: Window = None,
    smooth: Smooth = False,
    smoothing_window: SmoothingWindow = None,
) -> None:
    """Convert a recording to SI units and another file format; for TDMS and CSV also write its mapping file."""
    from pipeline.rig.recordings import mapping_for, write_recording
    from pipeline.rig.recordings.writing import SUFFIXES
    from pipeline.specification.files import check_new_file

    check_new_file(out, SUFFIXES)
    _check_recording(out)
    _keep(file, out)
    ds = _smoothed(_read(file, mapping, window), smooth, smoothing_window)
    with_mapping = out.suffix.lower() != ".nc"
    text = mapping_for(ds, out).toml() if with_mapping else ""
    beside = _beside(out, text) if with_mapping else out
    console.result(f"recording: {write_recording(ds, out)}")
    if with_mapping:
        write_atomically(beside, text)
        console.result(f"mapping: {beside}")


def simulate(
    spec: Annotated[Path, typer.Argument(metavar="SPEC", help="Virtual rig (TOML).")],
    out: Annotated[Path, typer.Option(help="File to write: .tdms or .csv; the mapping goes beside it.")],
) -> None:
    """Simulate a recording of an experiment, and write it with the mapping file that reads it."""
    from pipeline.rig.recordings.writing import SUFFIXES, write_raw
    from pipeline.rig.virtual import load_rig, simulated
    from pipeline.specification.files import check_new_file
    from pipeline.specification.problems import SpecError

    check_new_file(out, SUFFIXES[:2])
    _check_recording(out)
    beside = out.with_suffix(".toml")
    if beside.resolve() == spec.resolve():
        raise SpecError(f"--out {out}: its mapping would replace {spec}; give another name.")
    raw, mapping = simulated(load_rig(spec), is_csv=out.suffix.lower() == ".csv")
    beside = _beside(out, mapping.toml())
    console.result(f"recording: {write_raw(raw, out)}")
    write_atomically(beside, mapping.toml())
    console.result(f"mapping: {beside}")


def drive(
    file: File,
    mapping: Annotated[Path, typer.Option(metavar="MAP", help=MAPPING)],
    kind: Annotated[
        Literal["edges", "torque"], typer.Option(help="Content: the times at which the drive switches, or its values.")
    ] = "edges",
    out: Annotated[Path, typer.Option(help="Drive file, .csv.")] = Path("drive.csv"),
    window: Window = None,
    tolerance: Annotated[
        float, typer.Option(help="Drop samples of a torque that interpolation meets this closely [N m].")
    ] = 0.0,
) -> None:
    """Write a recorded drive as a file that ``magpend run`` and ``simulate`` accept.

    The command prints frequency, jitter and duty cycle. With edges, the model gives shape and amplitude.
    """
    from pipeline.rig.drive_file import drive_file
    from pipeline.specification.files import check_new_file

    check_new_file(out, (".csv",))
    check_file(out)
    made = drive_file(_read(file, mapping, window), kind, tolerance=tolerance)
    write_atomically(out, made.text)
    for note in made.notes:
        console.note(note)
    if made.timing is not None:
        t = made.timing
        console.result(f"frequency: {t.frequency_hz:.8g} +- {t.frequency_error_hz:.2g} Hz, {t.n_periods} periods")
        console.result(f"jitter: {t.jitter_s:.3g} s")
        console.result(f"duty cycle: {t.duty_cycle:.6g} +- {t.duty_cycle_error:.2g}")
    if kind == "torque":
        console.result(f"samples: {made.n_rows} of {made.n_samples} kept; the others lie within {made.error:.3g} N m")
    console.result(f"drive: {out}")


def _keep(file: Path, out: Path) -> None:
    from pipeline.specification.problems import SpecError

    if out.exists() and file.exists() and out.samefile(file):
        raise SpecError(f"--out {out}: is the input file; give another name.")


def _check_recording(out: Path) -> None:
    """Raise an error for a recording's path that lies in a run directory, or names a file of another program."""
    check_place(out)
    if not out.with_suffix(".toml").exists():
        check_file(out)


def _beside(out: Path, text: str) -> Path:
    """Return the path of the mapping file (the channels of a recording); raise SpecError if another file is there."""
    from pipeline.specification.problems import SpecError

    path = out.with_suffix(".toml")
    if path.exists() and path.read_bytes() != text.encode():
        raise SpecError(
            f"--out {out}: its mapping would replace {path}, which holds something else; give another "
            "name, or move that file away."
        )
    return path


def _read(file: Path, mapping: Path, window: tuple[float, float] | None) -> xr.Dataset:
    from pipeline.rig.recordings import read_recording

    return read_recording(file, mapping, window_s=window)


def _smoothed(ds: xr.Dataset, wanted: bool, window_s: float | None) -> xr.Dataset:
    from pipeline.rig.recordings import smooth

    return smooth(ds, window_s=window_s) if wanted or window_s is not None else ds


def _tell(ds: xr.Dataset, as_json: str | None) -> None:
    from pipeline.rig.recordings.overview import describe_recording

    quantities, findings = describe_recording(ds)
    keys = ("file", "sha256", "format", "model", "sampling_rate_hz", "simulated")
    about: dict[str, Any] = {key: ds.attrs[key] for key in keys if key in ds.attrs}
    about |= {"samples": ds.sizes["sample"], "pieces": len(set(ds["piece"].values.tolist()))}
    told = {**about, "quantities": json_rows(quantities), "findings": json_rows(findings)}
    tell_data(told, [*quantities.lines, *findings.lines], as_json)


def _save(figure: DataFigure, out: Path, others: str | None) -> None:
    """Write a figure and its data; their paths are notes if another output is printed."""
    from pipeline.plots import save_data, save_figure

    say = console.note if others else console.result
    say(f"figure: {save_figure(figure, out)}")
    say(f"data: {save_data(figure, out)}")


def _draw(ds: xr.Dataset, out: Path, as_json: str | None) -> None:
    from pipeline.plots import save_figure
    from pipeline.rig.recordings.figure import plot_recording

    say = console.note if as_json else console.result
    say(f"figure: {save_figure(plot_recording(ds), out)}")


for _command in (drawing(show), drawing(spectrum), drawing(analyse), convert, drive, simulate):
    add_command(recordings_app, _command)
