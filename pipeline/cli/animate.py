"""Define ``magpend animate``, which draws a motion as GIF, WebP or MP4."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli import console
from pipeline.cli.common import PresetName, Set, read_pairs
from pipeline.cli.models import DEFAULT
from pipeline.cli.outputs import check_file
from pipeline.cli.simulate import Frequency, ModelName, read_states

if TYPE_CHECKING:
    from pipeline.runs.filming import Start
    from pipeline.store.run import RunDirectory


def animate(
    context: typer.Context,
    directory: Annotated[
        str | None, typer.Argument(metavar="[DIR]", help="Run directory, or s3://BUCKET/PREFIX.")
    ] = None,
    at: Annotated[
        list[str] | None,
        typer.Option(metavar="AXIS=VALUE", help="Value of an axis of the run, for the parameter point."),
    ] = None,
    nearest: Annotated[
        bool,
        typer.Option(
            "--nearest", help="Use the axes' values nearest to --at, and print them; otherwise --at must match."
        ),
    ] = False,
    attractor: Annotated[
        list[str] | None, typer.Option(metavar="LETTER", help="Attractor at the point; by default all, side by side.")
    ] = None,
    cell: Annotated[
        list[int] | None, typer.Option(metavar="N", help="Flat index of a cell of the run, to show instead.")
    ] = None,
    model: ModelName = None,
    frequency_hz: Frequency = None,
    preset: PresetName = None,
    settings: Set = None,
    transient: Annotated[int, typer.Option(help="For a start: periods before the film begins.")] = 0,
    seconds: Annotated[float | None, typer.Option(help="Length of the film [s]; else 8.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second, GIF at most 50. Default: 25.")] = None,
    speed: Annotated[
        float | None,
        typer.Option(
            help="Seconds of the model in one of film, changed by 10 % at most so that whole periods are "
            "shown; else such that a period takes about two."
        ),
    ] = None,
    size: Annotated[
        int | None, typer.Option(help="Width of a frame [pixels]; the height follows. Default: 800.")
    ] = None,
    portrait: Annotated[str | None, typer.Option(metavar="STATE", help="State whose phase portrait is shown.")] = None,
    degrees: Annotated[bool, typer.Option("--degrees", help="Use degrees instead of radians.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="File, .gif, .webp or .mp4; by default in DIR/figures, or animation.gif.")
    ] = None,
) -> None:
    """Draw moving motions as GIF, WebP or MP4: the model's drawing, and phase portraits.

    With a run, the film shows its attractors at a parameter point (--at) side by side, the cells that you
    name with --cell, or your own start at that point. Without a run it shows a start of a model, which --model,
    --frequency, --preset and --set choose. Give a start by the model's names: --NAME VALUE, or --NAME-deg VALUE
    for an angle or its rate; other states are 0. A periodic motion gives a film without a jump. MP4 needs ffmpeg.
    """
    from pipeline.plots.animation import film_problems, save_animation
    from pipeline.plots.figure import save_data
    from pipeline.runs.filming import animation
    from pipeline.specification.problems import SpecError
    from pipeline.store.files import FIGURES
    from pipeline.store.local import make_folder, refuse_links, unwritable
    from pipeline.store.run import RunDirectory

    words = list(context.args)
    if directory is not None and directory.startswith("--"):  # not a directory, but the first state's option
        words, directory = [directory, *words], None
    start = _start(words, model, frequency_hz, preset, settings, transient, directory is None)
    points = read_pairs("--at", at or [], "frequency=2.2")
    clock = {"seconds": seconds, "fps": fps, "speed": speed, "size": size, "portrait": portrait}
    options: dict[str, Any] = {k: v for k, v in clock.items() if v is not None}
    options |= {"at": points, "nearest": nearest, "degrees": degrees}
    run = None if directory is None else RunDirectory.open(directory)
    target = out or _place(run, points, attractor, cell)
    problems = _contradictions(directory, points, attractor, cell, start)
    problems += film_problems(target, 25.0 if fps is None else fps)
    if out is not None and not target.parent.is_dir():
        problems.append(f"{target.parent}: no such folder; make it first.")
    if out is not None and not problems:
        for file in (out, out.with_suffix(".nc")):
            check_file(file, within=FIGURES)
    if out is None and run is not None:
        refuse_links(target.parent, target, target.with_suffix(".nc"))
    if problem := unwritable(target.parent):
        problems.append(f"{problem}; give another place: --out FILE.")
    if problems:
        raise SpecError(problems)
    film = animation(run, options, attractors=attractor or (), cells=cell or (), start=start, echo=console.note)
    if target.exists():
        console.note(f"note: {target} existed and is replaced")
    make_folder(target.parent)
    console.note(film.summary)
    console.result(f"animation: {save_animation(film, target)}")
    console.result(f"data: {save_data(film.figure, target)}")


def _start(
    words: list[str],
    model: str | None,
    frequency_hz: float | None,
    preset: str | None,
    settings: list[str] | None,
    transient: int,
    alone: bool,
) -> Start | None:
    """Read the initial state, the model and its parameters from the options; None if a run's own motions are
    animated.
    """
    from pipeline.compute.simulate import with_rate
    from pipeline.runs.filming import Start
    from pipeline.specification.models import find_model
    from pipeline.specification.problems import SpecError

    states = read_states(words)
    given = {"--model": model, "--frequency": frequency_hz, "--preset": preset, "--set": settings}
    if not alone and any(given.values()):
        raise SpecError([f"{k}: the run sets this; drop the option, or the directory." for k, v in given.items() if v])
    if not alone and not states and not transient:
        return None
    overrides = read_pairs("--set", settings or [], "q=1.5")
    known = find_model(model or DEFAULT, at="--model")
    frequency, overrides = with_rate(overrides.pop("frequency", frequency_hz), overrides, known)
    return Start(states, transient, model or DEFAULT, frequency, preset, overrides)


def _contradictions(
    directory: str | None,
    at: dict[str, float],
    attractor: list[str] | None,
    cell: list[int] | None,
    start: Start | None,
) -> list[str]:
    of_run: dict[str, Any] = {"--at": at, "--attractor": attractor, "--cell": cell}
    problems = []
    if directory is None:
        problems += [f"{k}: needs a run; give its directory." for k, v in of_run.items() if v]
    of_run["a start (--transient, or a state)"] = start
    chosen = [k for k, v in of_run.items() if v and k != "--at"]
    if directory is not None and len(chosen) > 1:
        problems.append(f"{' and '.join(chosen)}: a film shows one of these; drop the others.")
    if cell and at:
        problems.append("--at: a cell already has a parameter point; drop --at or --cell.")
    return problems


def _place(run: RunDirectory | None, at: dict[str, float], attractor: list[str] | None, cell: list[int] | None) -> Path:
    if run is None:
        return Path("animation.gif")
    files = run.info.files
    folder = files.local / "figures" if files.local else Path("figures") / files.name.rpartition("/")[2]
    parts = [f"{name}_{value:.15g}" for name, value in at.items()]
    parts += [f"{k}_{'_'.join(map(str, v))}" for k, v in (("attractor", attractor), ("cell", cell)) if v]
    return folder / ("_".join(["animation", *parts]) + ".gif")
