"""Define ``magpend fit-magnet``, which fits measured torque curves and writes a parameter preset."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli import console
from pipeline.cli.common import Json, tell_data
from pipeline.cli.options import drawing
from pipeline.cli.outputs import check_place


@drawing
def fit_magnet(
    measurement: Annotated[
        str,
        typer.Argument(
            metavar="MEASUREMENT", help="Header of a table of torque readings (TOML), or discs, an example that ships."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the results; by default named after the header.")
    ] = None,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures.")] = False,
    json: Json = None,
) -> None:
    """Fit the magnets' torque to measured curves: a report, figures, and a preset for specifications.

    The command fits single curves, then all curves at once, and point dipoles for comparison. If a fit does
    not converge, nothing is written.
    """
    from pipeline.rig.magnet.fitting import fit_measurement
    from pipeline.rig.magnet.measurement import find_measurement, read_measurement
    from pipeline.rig.magnet.results import report_of, summary_of, warnings_of, write_results

    header = find_measurement(measurement)
    folder = _folder(out or Path(header.stem + "-fit"))
    outcome = fit_measurement(read_measurement(header))
    folder.mkdir(exist_ok=True)
    written = write_results(outcome, folder)
    if not no_figures:
        from pipeline.rig.magnet.figures import write_figures

        written += write_figures(outcome, folder)
    for warning in warnings_of(outcome):
        console.LOG.warning(warning)
    tell_data(report_of(outcome), summary_of(outcome), json)
    console.note(*(f"written: {path}" for path in written))
    preset = folder / "preset.toml"
    console.note(f'use it with preset = "{preset}" in a specification, or magpend simulate --preset {preset}')


def _folder(path: Path) -> Path:
    from pipeline.specification.problems import SpecError

    if path.exists() and not path.is_dir():
        raise SpecError(f"--out {path}: is a file; give a folder.")
    if not path.parent.is_dir():
        raise SpecError(f"{path.parent}: no such folder; make it first.")
    check_place(path)
    return path
