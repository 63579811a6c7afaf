"""Define ``magpend measured``: bifurcation diagrams of recorded sweeps, alone or compared with a run.

These commands take recordings and their mapping; a run is only used for comparison. They are therefore not
among the analyses and figures of a run, which read its cells alone.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.common import (
    MAPPING,
    PRINTED,
    Csv,
    Directory,
    Json,
    PresetName,
    Set,
    check_csv,
    json_rows,
    read_pairs,
    tell,
    tell_data,
)
from pipeline.cli.groups import command_group, made, registry_group
from pipeline.cli.options import drawing, taking
from pipeline.cli.outputs import check_file, check_place
from pipeline.cli.plot import check_figure_path
from pipeline.layout.writing import write_atomically

if TYPE_CHECKING:
    import xarray as xr

    from magpend_core.models.model import Model, Parameters
    from pipeline.rig.recordings import Mapping

Recordings = Annotated[
    list[Path], typer.Argument(metavar="RECORDING...", help="Recordings of sweeps of the drive frequency.")
]
Mappings = Annotated[list[Path], typer.Option("--mapping", metavar="MAP", help=f"{MAPPING} One for all, or for each.")]


def _load(paths: list[Path], mappings: list[Path]) -> list[Mapping]:
    """Read the file that describes the channels of each recording (its mapping); raise SpecError unless all name the
    same model.
    """
    from pipeline.rig.recordings import load_mapping
    from pipeline.specification.problems import SpecError

    if len(mappings) not in (1, len(paths)):
        raise SpecError(f"--mapping: {len(mappings)} for {len(paths)} recordings; give one for all, or one for each.")
    loaded = [load_mapping(m) for m in mappings] * (len(paths) if len(mappings) == 1 else 1)
    models = sorted({m.system for m in loaded}, key=lambda model: model.name)
    if len(models) > 1:
        raise SpecError(
            f"--mapping: the mappings name several models ({', '.join(m.name for m in models)}); a diagram has one."
        )
    return loaded


def _read(paths: list[Path], mappings: list[Mapping]) -> list[xr.Dataset]:
    from pipeline.rig.recordings import findings_of, read_recording, summary

    found = [read_recording(p, m) for p, m in zip(paths, mappings, strict=True)]
    for path, recording in zip(paths, found, strict=True):
        for line in summary(f for f in findings_of(recording) if f.severity != "note"):
            console.note(f"{path.name}: {line}")
    return found


def _loaded(model: Model, preset: str | None, settings: list[str] | None) -> Parameters:
    return model.load(preset, **read_pairs("--set", settings or [], "q=1.5"))


def _check_targets(out: Path | None, csv: str | None = None) -> None:
    check_csv(csv)
    if out is not None:
        check_figure_path(out)


def _save(figure: Any, target: Path) -> None:
    from pipeline.plots import save_data, save_figure

    console.result(f"figure: {save_figure(figure, target)}")
    console.result(f"data: {save_data(figure, target)}")


def steps(
    recordings: Recordings,
    mapping: Mappings,
    options: Any,
    preset: PresetName = None,
    settings: Set = None,
    csv: Csv = None,
    as_json: Json = None,
) -> None:
    """List the frequency steps of a recorded sweep: frequency, jitter, duty cycle, orbit period and its confidence.

    Motions are classified, for example by side, with the preset's parameters.
    """
    from pipeline.rig.measured.diagram import measure, steps_table

    _check_targets(None, csv)
    mappings = _load(recordings, mapping)
    parameters = _loaded(mappings[0].system, preset, settings)
    tell(steps_table(measure(_read(recordings, mappings), options, parameters=parameters)), csv, as_json)


def diagram(
    recordings: Recordings,
    mapping: Mappings,
    out: Annotated[Path, typer.Option(help="Figure, .png, .pdf or .svg.")],
    options: Any,
    run: Annotated[Path | None, typer.Option(metavar="DIR", help="Run whose diagram is drawn for comparison.")] = None,
) -> None:
    """Draw the measured bifurcation diagram, alone or with a run's diagram on the same axes."""
    from pipeline.plots import Frame
    from pipeline.rig.measured.diagram import measure
    from pipeline.rig.measured.figures import plot_measured
    from pipeline.runs.derive import refused

    _check_targets(out)
    mappings = _load(recordings, mapping)
    cube = parameters = None
    if run is not None:
        from pipeline.rig.measured.computed import cube_and_parameters
        from pipeline.runs.derive import AnalysedRun

        cube, parameters = cube_and_parameters(AnalysedRun.of(run), mappings[0].system, options.at)
    found = measure(_read(recordings, mappings), options, parameters=parameters)
    with refused(run or out):
        figure = plot_measured(
            found, cube, frame=Frame(options.width), state=options.state, degrees=options.degrees, layout=options.layout
        )
    _save(figure, out)


def compare(
    directory: Directory,
    recordings: Recordings,
    mapping: Mappings,
    out: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Folder for figures, tables and data; made if necessary.")
    ],
    options: Any,
    csv: Csv = None,
    as_json: Json = None,
) -> None:
    """Compare a measured sweep with the attractors of a run.

    For each step the command lists the nearest attractor, its distance in units of noise, and whether period
    and side agree. For each window edge it lists the shift from the model's edge [Hz]. It writes
    comparison.png, beside.png, over.png, steps.csv, edges.csv and comparison.nc to FOLDER.
    """
    from pipeline.plots import Frame
    from pipeline.rig.measured.comparison import compare_with, edges_table, summary_lines
    from pipeline.rig.measured.computed import Computed, cube_and_parameters
    from pipeline.rig.measured.diagram import measure, steps_table
    from pipeline.rig.measured.figures import write_comparison
    from pipeline.runs.derive import AnalysedRun, refused

    _check_targets(None, csv)
    check_place(out)
    run = AnalysedRun.of(directory, console.note)
    mappings = _load(recordings, mapping)
    _, parameters = cube_and_parameters(run, mappings[0].system, options.at)
    found = measure(_read(recordings, mappings), options, parameters=parameters)
    computed = Computed.of(run, mappings[0].system, options.at)
    compared = compare_with(found, computed)
    with refused(directory):
        written = write_comparison(
            compared, computed, out, frame=Frame(options.width), state=options.state, degrees=options.degrees
        )
    steps_of, ends = steps_table(compared), edges_table(compared)
    if as_json is not None:
        tell_data({"steps": json_rows(steps_of), "edges": json_rows(ends)}, (), as_json)
    if as_json == PRINTED:
        return
    tell(steps_of, csv, None)
    if csv == "-":
        return
    console.result(*ends.lines, *summary_lines(compared))
    console.note(*(f"written: {path}" for path in written))


def series(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="Recording with a drive.")],
    mapping: Annotated[Path, typer.Option(metavar="MAP", help=MAPPING)],
    out: Annotated[Path, typer.Option(help="Figure, .png, .pdf or .svg.")],
    options: Any,
    preset: PresetName = None,
    settings: Set = None,
) -> None:
    """Draw a recording and the model from the same state: time series and phase portraits."""
    from pipeline.plots import Frame
    from pipeline.rig.measured.figures import plot_series
    from pipeline.rig.measured.series import series_of
    from pipeline.runs.derive import refused

    _check_targets(out)
    mappings = _load([recording], [mapping])
    parameters = _loaded(mappings[0].system, preset, settings)
    (found,) = _read([recording], mappings)
    ds = series_of(
        found,
        parameters,
        start_s=options.start_s,
        n_periods=options.periods,
        window_s=options.window_s,
        hysteresis=options.hysteresis,
    )
    with refused(recording):
        figure = plot_series(ds, degrees=options.degrees, frame=Frame(options.width))
    for name, value in json.loads(str(ds.attrs["rms"])).items():
        console.result(f"rms of {name}: {value:.4g} {ds[name].attrs['units']}")
    _save(figure, out)


def branch(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SPEC|CSV", help="Specification with [measured.branch], file or shipped, or a table of orbits."
        ),
    ],
    options: Any,
    over: Annotated[Path | None, typer.Option(metavar="RUN", help="Run whose branches they are compared with.")] = None,
    model: Annotated[str, typer.Option(help="Model of a CSV table without --over: its name, or a file.")] = "",
    out: Annotated[Path | None, typer.Option(help="Figure, .png, .pdf or .svg.")] = None,
    csv: Csv = None,
    as_json: Json = None,
) -> None:
    """Measure recorded orbits along a parameter, stable and unstable, and compare them with a run's branches.

    Lists amplitude, frequency and their scatter over the cycles. With --over also the computed orbit of the same
    stability, the error in per cent, and the distance in units of the scatter.
    """
    from pipeline.rig.measured.branch import branch_table, compare, read_branch
    from pipeline.rig.measured.branch_computed import amplitudes
    from pipeline.rig.measured.branch_figure import plot_branch
    from pipeline.specification.files import find_spec

    _check_targets(out, csv)
    path = find_spec(source)
    branches = computed = None
    if over is None:
        from magpend_core.models import load_model

        found = read_branch(path, load_model(model) if model else None, options.state)
    else:
        from pipeline.cli import console
        from pipeline.layout.vocabulary import parameters_of
        from pipeline.runs.derive import AnalysedRun

        run = AnalysedRun.of(over, console.note)
        found = read_branch(path, run.model, options.state)
        branches = run.derive("branches", parameter=str(found.attrs["parameter"]))
        computed = amplitudes(branches, parameters_of(run.cube()), str(found.attrs["state"]))
        found = compare(found, branches, computed)
    tell(branch_table(found), csv, as_json)
    if out is not None:
        from pipeline.plots import Frame

        _save(plot_branch(found, branches, computed, frame=Frame(options.width)), out)


def trace(
    spec: Annotated[Path, typer.Argument(metavar="SPEC", help="Virtual rig with the table [control] (TOML).")],
    out: Annotated[Path, typer.Option(help="Table of orbits to write, .csv.")],
) -> None:
    """Trace a branch of a virtual rig by control-based continuation, through its unstable orbits.

    A controller keeps the rig near each target until its output is one cosine: the response is then an orbit of
    the rig under this drive. The table is what measured branch reads.
    """
    from pipeline.rig import control

    check_file(out)
    rig, targets = control.load_control(spec)
    found = control.trace(rig, targets)
    write_atomically(out, control.orbits_csv(rig, found))
    counts = ", ".join(f"{found.stable.count(word)} {name}" for word, name in _STABLE.items())
    console.result(f"{len(targets)} orbits by the slope of the branch: {counts}")
    console.result(f"largest further harmonic of the drive: {100.0 * found.residue.max():.2g} % of the first")
    console.result(f"table: {out}")


_STABLE = {"yes": "stable", "no": "unstable", "unknown": "unknown"}

_COMMANDS: dict[str, tuple[Any, str]] = {
    "steps": (steps, "SweepOptions"),
    "diagram": (diagram, "DiagramOptions"),
    "compare": (compare, "ComparisonOptions"),
    "series": (series, "SeriesOptions"),
    "branch": (branch, "MeasuredBranchOptions"),
    "trace": (trace, ""),
}
"""Commands, and the names of their options in `pipeline.rig.measured.declaration`; empty if there are none."""

_DRAWING = ("diagram", "compare", "series", "branch")


def _make(name: str) -> Any:
    from pipeline.rig.measured import declaration as measured

    function, options = _COMMANDS[name]
    command = taking(getattr(measured, options), function) if options else function
    command = drawing(command) if name in _DRAWING else command
    return made(name, command, str(function.__doc__))


measured_app = command_group(
    "Diagrams and branches of recorded motions, beside and over computed ones.",
    registry_group("measured", lambda: {"Commands": dict.fromkeys(_COMMANDS, "")}, _make),
)
