"""``magpend identify``: parameters of a model from recordings, and a judgement on other recordings."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from pipeline.cli.common import EXIT_HELP, Csv, Json
from pipeline.cli.groups import SETTINGS
from pipeline.cli.options import completing, speaking

RUN = "spec"
"""Name of the command that ``magpend identify SPEC`` stands for."""


class IdentifyGroup(TyperGroup):
    """``magpend identify SPEC`` beside ``magpend identify check`` and ``compare``."""

    default = RUN

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the command that is meant before what is no command's name."""
        known = (*self.list_commands(ctx), "--help", "-h", "--install-completion", "--show-completion")
        meant = [self.default, *args] if args and args[0] not in known else args
        return list(super().parse_args(ctx, meant))


identify_app = typer.Typer(
    cls=IdentifyGroup,
    help="Identify parameters from recordings: magpend identify SPEC --out DIR; judge a result on another "
    "recording: magpend identify check DIR RECORDING; compare results: magpend identify compare DIR DIR.",
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings=SETTINGS,
)


def _identifications() -> Iterable[str]:
    from pipeline.runs.workflows import shipped_identifications

    return shipped_identifications()


def identify(
    spec: Annotated[
        str,
        typer.Argument(
            metavar="SPEC",
            help="A TOML file, or the name of one that ships.",
            autocompletion=completing(_identifications),
        ),
    ],
    out: Annotated[Path | None, typer.Option(help="Directory; by default runs/NAME.")] = None,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Write numbers alone.")] = False,
    as_json: Json = False,
) -> None:
    """Identify what a specification asks for, or what is missing of it: magpend identify SPEC --out DIR.

    Stop it whenever you like: the same command goes on where it was, and the finished files are the same.
    """
    from pipeline.cli import console
    from pipeline.rig.identify import identification
    from pipeline.rig.identify.directory import PRESET
    from pipeline.rig.identify.reports import lines_of

    result = identification.identify(spec, out, figures=not no_figures, echo=console.note)
    if as_json:
        console.result(json.dumps(result, indent=1))
        return
    for line in lines_of(result):
        console.result(line)
    console.result(f"preset: {identification.directory_of(spec, out) / PRESET}")


def check(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Directory of an identification.")],
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="A file with the same channels.")],
    like: Annotated[
        int, typer.Option(min=0, help="Number of the fitted recording whose mapping, drive and zeros it has.")
    ] = 0,
    as_json: Json = False,
) -> None:
    """Judge an identification on another recording: only the starts of its pieces are refitted."""
    from pipeline.cli import console
    from pipeline.rig.identify import check as checking
    from pipeline.rig.identify.reports import judgement_lines

    found = checking.check(directory, recording, like=like)
    if as_json:
        console.result(json.dumps(found, indent=1))
        return
    for line in judgement_lines(found, found["units"]):
        console.result(line)
    for piece in found["pieces"]:
        values = ", ".join(
            f"{name} {'-' if rms is None else format(rms, '.4g')} {found['units'][name]}"
            for name, rms in piece["rms"].items()
        )
        console.result(f"piece {piece['piece']}: {values}")


def compare(
    directories: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Finished identifications.")],
    as_json: Json = False,
    csv: Csv = None,
) -> None:
    """Put identifications side by side, best first: laws are compared by held-out pieces, not by the fit."""
    from pipeline.cli.common import check_csv, tell
    from pipeline.rig.identify.comparison import compare as comparing

    check_csv(csv)
    tell(comparing(directories), csv, as_json)


identify_app.command(RUN, epilog=EXIT_HELP, context_settings=SETTINGS)(speaking(identify))
identify_app.command("check", epilog=EXIT_HELP, context_settings=SETTINGS)(speaking(check))
identify_app.command("compare", epilog=EXIT_HELP, context_settings=SETTINGS)(speaking(compare))
