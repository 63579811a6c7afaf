"""Draw films of motions (the model's drawing, and phase portraits beside it), and write them as GIF, WebP or MP4.

The background is drawn once, and only the moving artists are drawn anew. So a frame takes a few milliseconds.
"""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image, features

from magpend_core.models.model import Model
from pipeline.layout.vocabulary import model_of
from pipeline.layout.writing import temporary_beside, writing
from pipeline.plots import labels, style
from pipeline.plots.looks import MM
from pipeline.plots.movers import Scene, Trail, moving_clock, moving_machine, moving_portrait

SCREEN_DPI = 100
"""Letters of films of every size: 12 pixels and more."""

LEAST_LABELLED_IN = 1.0
"""Portraits narrower than this have no tick labels: these would cover each other."""

LEAST_NAMED_IN = 1.35
"""Narrower drawings have no names and no scale bar."""

LEAST_HIGH_IN = 0.6
"""Least height of a portrait."""

MOST_ABREAST = 4
"""Motions beside one another; more begin a second row."""

Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Animation:
    """A film, whose frames are drawn when they are needed."""

    figure: style.DataFigure  # the figure; its `data` hold the numbers drawn
    movers: tuple[Any, ...]  # moving parts; each places its artists for a given sample

    @property
    def n_frames(self) -> int:
        """Return the number of frames."""
        return int(self.figure.data.attrs["n_frames"])

    @property
    def fps(self) -> float:
        """Return the frames per second."""
        return float(self.figure.data.attrs["fps"])

    @property
    def summary(self) -> str:
        """Return a text on the film: its frames, its length, and how much faster or slower than reality it runs."""
        data = self.figure.data
        shown, frequencies = float(data["time"][-1]), np.unique(data["drive_frequency"].values)
        told = f"{shown:.4g} s of the model"
        if model_of(data).clock.has_drive and len(frequencies) == 1:
            told += f" ({shown * frequencies[0]:.4g} drive periods)"
        told += f", {float(data.attrs['speed']):.3g} \N{MULTIPLICATION SIGN} real time"
        return f"{self.n_frames} frames, {self.n_frames / self.fps:.3g} s: {told}"

    def frames(self) -> Iterator[Pixels]:
        """Draw the frames one after another, and yield them as RGB images (height, width, 3)."""
        canvas: Any = FigureCanvasAgg(self.figure)
        with style.LOCK:
            canvas.draw()
        background = canvas.copy_from_bbox(self.figure.bbox)
        substeps = int(self.figure.data.attrs["substeps"])
        for k in range(self.n_frames):
            with style.LOCK:
                canvas.restore_region(background)
                for mover in self.movers:
                    for artist in mover.at(k * substeps):
                        self.figure.draw_artist(artist)
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


@style.drawn
def plot_animation(ds: xr.Dataset, *, degrees: bool = False, portrait: str = "", size: int = 800) -> Animation:
    """Lay out a film that shows one or more motions side by side.

    `ds` is from `pipeline.runs.instants.filmed`, with the attribute ``fps``; `size` is the width of a frame [pixels],
    even for video encoders. By default a single motion shows all portraits, and several the model's first. Motions that
    repeat within the film show their whole path from the start; other paths grow as the film runs. Dots are section
    points. Raise ValueError if there is no portrait of that state, or degrees are asked for of a model without angles.
    """
    model = model_of(ds)
    pairs = portraits_of(model, portrait, ds.sizes["motion"], degrees)
    plan = _Plan.of(ds.sizes["motion"], len(pairs), model.drawing is not None, size)
    frame = style.Frame(plan.width / MM)
    fig = style.new_figure(plan.height, ds, frame, arranged=False, exact=True)
    fig.set_dpi(SCREEN_DPI)
    movers: list[Any] = []
    scene = None if model.drawing is None else Scene.of(ds, model.drawing)
    for k in range(ds.sizes["motion"]):
        one = ds.isel(motion=k)
        boxes = plan.boxes(k)
        _title(fig, plan, boxes[0], str(one["name"].values))
        trail = Trail.of(one)
        named = k == 0 and boxes[0][2] * plan.width >= LEAST_NAMED_IN
        if scene is not None:
            movers.append(moving_machine(fig.add_axes(boxes[0]), scene, one, trail, named=named))
        places = boxes[scene is not None :]
        for pair, place in zip(pairs, places, strict=True):
            ax = fig.add_axes(place)
            movers.append(moving_portrait(ax, one, pair, trail, degrees))
            ax.tick_params(labelleft=plan.labelled, labelbottom=plan.labelled)
            if place[2] * plan.width < 2.0 * LEAST_LABELLED_IN:
                style.few_ticks(ax, 3, 3)
    movers.append(moving_clock(fig, ds))
    style.finish(fig)
    return Animation(fig, tuple(movers))


def portraits_of(model: Model, portrait: str, n: int, degrees: bool = False) -> tuple[tuple[str, str], ...]:
    """Return the pairs of states whose phase portraits a film of `n` motions shows; ValueError on invalid options."""
    labels.some_angle(model, degrees, "animations")
    if portrait:
        found = tuple(pair for pair in model.portraits if portrait in pair)
        if not found:
            known = ", ".join(dict.fromkeys(name for pair in model.portraits for name in pair))
            raise ValueError(f"unknown portrait {portrait!r}; there are portraits of: {known}")
        return found[:1]
    return model.portraits[: 3 if n == 1 else 1]


# ---- places ------------------------------------------------------------------------------------

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class _Plan:
    """Positions of the panels of a film's frame [in]."""

    n: int
    n_pairs: int
    drawn: bool
    width: float
    columns: int
    drawing: float
    portrait: float
    left: float
    below: float
    above: float
    labelled: bool

    @classmethod
    def of(cls, n: int, n_pairs: int, drawn: bool, size: int) -> _Plan:
        width = 2 * round(size / 2) / SCREEN_DPI
        columns = n if n <= MOST_ABREAST else math.ceil(n / 2)
        room = width / columns if n > 1 else 0.48 * width if drawn else width / n_pairs
        labelled = room - 0.86 >= LEAST_LABELLED_IN
        left, below, above = (0.74, 0.46, 0.3) if labelled else (0.3, 0.3, 0.3)
        if n == 1:
            stacked = n_pairs if drawn else 1
            margins = above + below * (stacked + 0.6)
            height = min(0.56 * width, 6.0) if drawn or n_pairs > 1 else 0.7 * width
            height = max(height, margins + LEAST_HIGH_IN * stacked)
            portrait = (height - margins) / stacked
            return cls(n, n_pairs, drawn, width, 1, height - above - below, portrait, left, below, above, labelled)
        pitch = width / columns
        return cls(
            n,
            n_pairs,
            drawn,
            width,
            columns,
            0.95 * pitch if drawn else 0.0,
            max(0.55 * (pitch - left), LEAST_HIGH_IN),
            left,
            below,
            above,
            labelled,
        )

    @property
    def row(self) -> float:
        if self.n == 1:
            return self.drawing + self.above
        return self.above + self.drawing + self.n_pairs * (self.portrait + self.below)

    @property
    def foot(self) -> float:
        return self.below if self.n == 1 else 0.5 * self.below

    @property
    def height(self) -> float:
        """Return the height of a frame [in], rounded to an even number of pixels."""
        whole = self.foot + self.row * math.ceil(self.n / self.columns)
        return 2 * round(whole * SCREEN_DPI / 2) / SCREEN_DPI

    def boxes(self, k: int) -> list[Box]:
        """Return the rectangles of the panels of motion `k`: the model's drawing if it has one, then portraits."""
        return [self._box(*inches) for inches in (self._single() if self.n == 1 else self._column(k))]

    def _single(self) -> list[Box]:
        air = 0.12
        if not self.drawn:
            pitch = self.width / self.n_pairs
            top = 0.5 * self.foot + self.below
            high = self.height - top - self.above
            return [(i * pitch + self.left, top, pitch - self.left - air, high) for i in range(self.n_pairs)]
        half = min(0.52 * self.width, 1.25 * self.drawing)
        boxes = [(air, self.foot, half - 2.0 * air, self.drawing)]
        for i in range(self.n_pairs):
            y = self.height - self.above - (i + 1) * self.portrait - i * self.below
            boxes.append((half + self.left, y, self.width - half - self.left - air, self.portrait))
        return boxes

    def _column(self, k: int) -> list[Box]:
        air, pitch = 0.08, self.width / self.columns
        x = (k % self.columns) * pitch
        top = self.height - (k // self.columns) * self.row - self.above
        boxes = [(x + air, top - self.drawing, pitch - 2.0 * air, self.drawing)] if self.drawn else []
        for i in range(self.n_pairs):
            y = top - self.drawing - (i + 1) * self.portrait - i * self.below
            boxes.append((x + self.left, y, pitch - self.left - air, self.portrait))
        return boxes

    def _box(self, x: float, y: float, width: float, height: float) -> Box:
        return (x / self.width, y / self.height, width / self.width, height / self.height)


def _title(fig: style.DataFigure, plan: _Plan, box: Box, text: str) -> None:
    room = plan.width / plan.columns - 0.2
    lines = style.folded(text, room, fig.look.legend).split("\n")
    short = lines[0] if len(lines) == 1 else lines[0].rstrip(",:") + " \N{HORIZONTAL ELLIPSIS}"
    fig.text(box[0], box[1] + box[3] + 0.07 / plan.height, short, fontsize=fig.look.legend, va="bottom")


FILM_SUFFIXES = (".gif", ".webp", ".mp4")
MOST_GIF_FPS = 50.0
"""GIF counts hundredths of a second, and programs that show it take 1 for "as slow as before"."""

PALETTE_FRAMES, PALETTE_COLOURS = 8, 96


def film_problems(path: Path, fps: float) -> list[str]:
    """Return the reasons why a film cannot be written to a path, before anything is drawn."""
    suffix = path.suffix.lower()
    if suffix not in FILM_SUFFIXES:
        return [f"{path}: the suffix must be one of {', '.join(FILM_SUFFIXES)}."]
    problems = []
    if path.is_dir():
        problems.append(f"{path}: is a folder; name a file in it.")
    if suffix == ".gif" and fps > MOST_GIF_FPS:
        problems.append(f"{fps:g} frames a second: a GIF has at most {MOST_GIF_FPS:g}; take fewer, or write .webp.")
    if suffix == ".webp" and not features.check("webp"):
        problems.append(f"{path}: this Pillow was built without WebP; write .gif, or install another Pillow.")
    if suffix == ".mp4" and shutil.which("ffmpeg") is None:
        problems.append(f"{path}: MP4 takes the program ffmpeg, and there is none; install it, or write .gif.")
    return problems


def save_animation(film: Animation, path: str | Path) -> Path:
    """Write a film as GIF, WebP or MP4; the suffix of the path decides.

    GIF and WebP loop for ever. The file appears only when it is complete; an existing file is replaced.

    Parameters
    ----------
    film
        The film.
    path
        File to write; the folder must exist.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    ValueError
        If the file cannot be written, or the format does not take the film; see `film_problems`.
    OSError
        If ffmpeg fails.
    """
    path = Path(path)
    if problems := film_problems(path, film.fps):
        raise ValueError(" ".join(problems))
    part = temporary_beside(path).with_suffix(path.suffix)  # both writers go by the suffix
    write = {".gif": _gif, ".webp": _webp, ".mp4": _mp4}[path.suffix.lower()]
    try:
        with writing(path):
            write(film, part)
            part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path


def _about(film: Animation) -> str:
    attrs = film.figure.data.attrs
    return "magpend; " + "; ".join(
        f"{k}: {v}" for k, v in attrs.items() if k in ("title", "source", "run", "cube_digest")
    )


def durations(n: int, fps: float, grain_ms: int) -> list[int]:
    """Return the duration of each frame of a film [ms]: multiples of `grain_ms` that add up to the film's length."""
    ends = np.round(np.arange(n + 1) * (1000.0 / fps / grain_ms)).astype(int)
    return [int(d) * grain_ms for d in np.diff(ends)]


def _gif(film: Animation, path: Path) -> None:
    palette = _palette(film)
    images = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in film.frames())
    comment = _about(film).encode("utf-8")[:250]
    _save(film, path, images, 10, optimize=False, disposal=1, comment=comment)


def _webp(film: Animation, path: Path) -> None:
    images = (Image.fromarray(frame) for frame in film.frames())
    _save(film, path, images, 1, quality=75, method=4, xmp=_about(film).encode("utf-8"))


def _save(film: Animation, path: Path, images: Iterator[Image.Image], grain_ms: int, **options: Any) -> None:
    duration = durations(film.n_frames, film.fps, grain_ms)
    next(images).save(path, save_all=True, append_images=images, loop=0, duration=duration, **options)


def _palette(film: Animation) -> Image.Image:
    """Compute one colour palette for all frames, from a sample of the frames."""
    chosen = np.unique(np.linspace(0, film.n_frames - 1, PALETTE_FRAMES).astype(int))
    frames = np.vstack([f for k, f in enumerate(islice(film.frames(), int(chosen[-1]) + 1)) if k in chosen])
    inked = frames[(frames != 255).any(axis=-1)]
    # keep the background pure white: quantisation would average it with nearly white pixels
    found = Image.fromarray(inked[None]).quantize(PALETTE_COLOURS - 1, Image.Quantize.MEDIANCUT)
    palette = Image.new("P", (1, 1))
    colours = np.array((found.getpalette() or [])[: 3 * (PALETTE_COLOURS - 1)]).reshape(-1, 3)
    # no palette colour may be so near to white that the rough search picks it for white
    kept = colours[(colours < 248).any(axis=1)]
    palette.putpalette([255, 255, 255, *kept.ravel().tolist()])
    return palette


def _mp4(film: Animation, path: Path) -> None:
    frames = film.frames()
    first = next(frames)
    height, width = first.shape[:2]
    pixels = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {film.fps:.10g} -i - -an"
    coded = "-c:v libx264 -pix_fmt yuv420p -crf 20 -movflags +faststart -metadata"
    command = [*f"ffmpeg -y -loglevel error {pixels} {coded}".split(), f"comment={_about(film)}", str(path)]
    process: Any = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        for frame in chain([first], frames):
            process.stdin.write(frame.tobytes())
    except BrokenPipeError:
        pass  # ffmpeg has ended; its message follows
    _, said = process.communicate()
    if process.returncode:
        raise OSError(f"ffmpeg could not write {path.name}: {said.decode(errors='replace').strip()[-300:]}")
