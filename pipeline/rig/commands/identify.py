"""Define ``magpend identify``, which fits model parameters to recordings and tests them on other recordings."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from pipeline.cli import console
from pipeline.cli.common import Csv, Json, check_csv, json_rows, tell, tell_data
from pipeline.cli.groups import add_command, command_group
from pipeline.cli.options import completing, drawing

RUN = "spec"
"""Name of the command that ``magpend identify SPEC`` runs."""


class IdentifyGroup(TyperGroup):
    """Group of commands ``magpend identify``, in which ``magpend identify SPEC`` works without a command's name."""

    default = RUN

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the name of the default command, unless the first argument is the name of a command."""
        known = (*self.list_commands(ctx), "--help", "-h", "--install-completion", "--show-completion")
        meant = [self.default, *args] if args and args[0] not in known else args
        return list(super().parse_args(ctx, meant))


identify_app = command_group(
    "Identify parameters from recordings: magpend identify SPEC --out DIR; judge a result on another "
    "recording: magpend identify check DIR RECORDING; compare results: magpend identify compare DIR DIR; say how sure "
    "they are: magpend identify posterior DIR.",
    IdentifyGroup,
)


def _identifications() -> Iterable[str]:
    from pipeline.specification.files import shipped_identifications

    return shipped_identifications()


def identify(
    spec: Annotated[
        str,
        typer.Argument(
            metavar="SPEC",
            help="TOML file, or the name of an identification that ships.",
            autocompletion=completing(_identifications),
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Directory; by default runs/NAME.")] = None,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures.")] = False,
    as_json: Json = None,
) -> None:
    """Identify the parameters that a specification names: magpend identify SPEC --out DIR.

    You can stop the command at any time: the same command continues, and the finished files are the same.
    """
    from pipeline.rig.identify import identification
    from pipeline.rig.identify.directory import PRESET
    from pipeline.rig.identify.reports import lines_of

    result = identification.identify(spec, out, figures=not no_figures, echo=console.note)
    preset = identification.directory_of(spec, out) / PRESET
    tell_data(result, [*lines_of(result), f"preset: {preset}"], as_json)


def check(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Directory of an identification.")],
    recording: Annotated[
        Path, typer.Argument(metavar="FILE", help="A recording with the same channels, or a table of measured orbits.")
    ],
    like: Annotated[
        int, typer.Option(min=0, help="Index of the fitted recording with the same mapping, drive and zeros.")
    ] = 0,
    as_json: Json = None,
) -> None:
    """Test identified parameters on another recording, or on a table of measured orbits.

    Only the initial states of a recording's pieces are fitted. Orbits are compared with the computed branches.
    """
    from pipeline.rig.identify.validation import is_table

    if is_table(recording):
        _check_orbits(directory, recording, as_json)
        return
    from pipeline.rig.identify import validation as checking
    from pipeline.rig.identify.reports import judgement_lines

    found = checking.check(directory, recording, like=like)
    lines = judgement_lines(found, found["units"])
    for piece in found["pieces"]:
        values = ", ".join(
            f"{name} {'-' if rms is None else format(rms, '.4g')} {found['units'][name]}"
            for name, rms in piece["rms"].items()
        )
        lines.append(f"piece {piece['piece']}: {values}")
    tell_data(found, lines, as_json)


def posterior(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Directory of a finished identification.")],
    n: Annotated[int, typer.Option("-n", min=20, max=100_000, help="Number of draws.")] = 200,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of the draws.")] = 1,
    mcmc: Annotated[
        bool, typer.Option("--mcmc", help="Sample the posterior density by a chain (emcee) instead of the Gaussian.")
    ] = False,
    walkers: Annotated[
        int,
        typer.Option(
            min=0, help="Walkers of the chain; 0 for 32, or four times the number of unknowns if that is more."
        ),
    ] = 0,
    steps: Annotated[int, typer.Option(min=20, help="Most steps of the chain; it ends when it has converged.")] = 2000,
    spec: Annotated[
        str | None, typer.Option(help="Specification of the identification; --mcmc needs it if recordings were fitted.")
    ] = None,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures.")] = False,
    as_json: Json = None,
) -> None:
    """Draw parameter sets from an identification, and say how sure its diagram of measured orbits is.

    The draws are written to DIR/posterior.nc. With measured orbits they are carried through the branches: 95 %
    intervals of folds, doublings and Hopf points, and bands about the branches, in DIR/bands-N.nc and
    DIR/figures/bands-N.png.

    With --mcmc the draws come from a chain, whose convergence figures are printed. DIR keeps the chain: the same
    command goes on with a stopped one, and with more --steps it gets longer.
    """
    from pipeline.rig.identify.posterior import Sampling, write_posterior

    sampling = Sampling(walkers, steps, spec) if mcmc else None
    parameters, bifurcations, written = write_posterior(
        directory, n, seed, sampling=sampling, figures=not no_figures, echo=console.note
    )
    rows = {"parameters": json_rows(parameters), "bifurcations": json_rows(bifurcations)}
    tell_data(rows, [*parameters.lines, *bifurcations.lines], as_json)
    console.note(*(f"written: {path}" for path in written))


def spread(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of magpend run SPEC --posterior DIR.")],
    branches: Annotated[
        bool, typer.Option("--branches", help="Follow the branches of each run, and list their bifurcations.")
    ] = False,
    attractors: Annotated[
        bool, typer.Option("--attractors", help="Find the attractors of each run, and match them over the draws.")
    ] = False,
    as_json: Json = None,
    csv: Csv = None,
) -> None:
    """List how fractions of cells, attractors and bifurcations are distributed over the runs of a posterior."""
    from pipeline.rig.identify.posterior_runs import spread as spreading

    check_csv(csv)
    tell(spreading(folder, branches=branches, attractors=attractors, echo=console.note), csv, as_json)


def _check_orbits(directory: Path, table: Path, as_json: str | None) -> None:
    from pipeline.rig.identify.measured_orbits import orbit_lines
    from pipeline.rig.identify.validation import check_orbits

    found = check_orbits(directory, table)
    lines = []
    for one in found["orbits"]:
        error = "lost" if one["relative_error"] is None else f"{100.0 * one['relative_error']:+.1f} %"
        lines.append(f"{one['name']} ({one['stability']}): amplitude {one['amplitude']:.4g}, error {error}")
    lines += [line.removeprefix("fitted ") for line in orbit_lines([found])]
    tell_data(found, lines, as_json)


def compare(
    directories: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Finished identifications.")],
    as_json: Json = None,
    csv: Csv = None,
) -> None:
    """Compare identifications by their errors on held-out pieces or orbits; the best one comes first."""
    from pipeline.rig.identify.validation import compare as comparing

    check_csv(csv)
    tell(comparing(directories), csv, as_json)


add_command(identify_app, drawing(identify), RUN)
for _command in (check, drawing(posterior), spread, compare):
    add_command(identify_app, _command)
