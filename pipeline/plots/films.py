"""Write films to files: GIF and WebP by Pillow, MP4 by ffmpeg if it is installed."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, features

from pipeline.layout.writing import temporary_beside, writing
from pipeline.plots.animation import Animation

SUFFIXES = (".gif", ".webp", ".mp4")
MOST_GIF_FPS = 50.0
"""GIF counts hundredths of a second, and programs that show it take 1 for "as slow as before"."""

PALETTE_FRAMES, PALETTE_COLOURS = 8, 96


def film_problems(path: Path, fps: float) -> list[str]:
    """Return the reasons why a film cannot be written to a path, before anything is drawn."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        return [f"{path}: the suffix must be one of {', '.join(SUFFIXES)}."]
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
