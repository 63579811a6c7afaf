"""Do what pages say: ``python docs/run_tutorials.py [--pictures | --check] [PAGE...]``.

Pages are the tutorials, those of `FOLLOWED`, and all with a mark of a picture; without a name all are followed.

Each page is executed in a folder of its own, in this process but for what runs in the background. Marks in
comments, which no reader sees, stand before blocks:

    <!-- file: NAME -->       the block is written to this file
    <!-- file: NAME; quick: LINE | LINE -->   and so are these lines, which make the work smaller
    <!-- before: COMMAND -->  a command of magpend, executed first: a run that another page makes
    <!-- run -->              commands of magpend, or Python, are executed
    <!-- background -->       each line is a program that runs until the page ends
    <!-- printed -->          each line is among what the blocks before printed, numbers to a thousandth
    <!-- picture: FILE -->    the picture in the next line is this file
    <!-- run: slurm -->       as `run`, and with other commands of a shell; left out where there is no SLURM
    <!-- printed: slurm -->   as `printed`, after such blocks
    <!-- until: slurm; COMMAND; TEXT -->   the command is repeated until it prints the text

With ``--pictures`` all pictures are made again in the docs. With ``--check`` those that differ from these are
named, and the exit code is 1 if there are any. `NOT_MADE` lists those that no command makes. Runs compute in
this process (``--workers 0``), which is all that is different from typing.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parent
FOLLOWED = ("rig", "recorded-drives", "python")
"""Pages that are followed like tutorials."""
FOLDERS = ("tutorials", "coming-from")
PAGES = {
    p.stem: p
    for p in (
        *(p for f in FOLDERS for p in sorted((DOCS / f).glob("*.md"))),
        *(DOCS / f"{name}.md" for name in FOLLOWED),
    )
}
GALLERY = DOCS / "gallery"
COLOURS = 128
"""Colours in a picture of the gallery."""
NOT_MADE = {
    "atlas-tongues.png": "Arnold tongues, two minutes, by the command beside it",
    "branches-map.png": "curves over a map of two parameters, a quarter of an hour",
    "examples/flutter-bands.png": "bands of the flutter rig's fit with priors, which no specification that ships has",
    "explorer-notebook.png": "JupyterLab with the explorer, by docs/notebook_picture.py RUN FILE",
    "identification-residuals.png": "residuals of the identification that ships, which takes an hour",
    "measured.png": "a sweep of 101 frequencies on the virtual rig, beside a run of as many",
    "recordings.png": "the flutter rig's recording, a minute, by the command beside it",
    "report.png": "a browser's picture of a part of a report",
    "response-pendulum.png": "the response of the pendulum, half a minute, by the commands beside it",
    "rig-calibrated.png": "a diagram of the calibrated model of docs/rig.md beside the rig's",
    "tutorials/atlas.png": "the atlas of the pendulum, a quarter of an hour, by the commands beside it",
    "tutorials/events_0p1_2hz.png": "the same between 0.1 and 2 Hz, half an hour",
    "tutorials/events_2_3hz.png": "bars of the pendulum's attractors, ten minutes, by docs/pendulum_events.py",
}
"""Pictures in the docs that this program does not make, with what they show."""

PATIENCE_S = 120.0

_BLOCK = re.compile(
    r"<!-- (file|run|background|printed)(?:: ([^>]*?))? -->\n```(\w*)\n(.*?)```"
    r"|<!-- (until): (\w+); ([^;>]+); ([^>]+?) -->",
    re.DOTALL,
)
_BEFORE = re.compile(r"<!-- before: ([^>]+?) -->")
_PICTURE = re.compile(r"<!-- picture: (\S+) -->\n!\[[^\]]*\]\(([^)]+)\)")
_NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")


def pages() -> dict[str, Path]:
    """Return the pages that are followed by name: tutorials, and those with a picture that is made."""
    drawn = [p for p in (DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))) if pictures_of(p)]
    return {**PAGES, **{path.stem: path for path in drawn}}


def pictures_of(page: Path) -> list[Path]:
    """Return the pictures that a page makes."""
    return [(page.parent / shown).resolve() for _, shown in _PICTURE.findall(page.read_text("utf-8"))]


class TutorialError(AssertionError):
    """A page says what is not so."""


@dataclass
class Session:
    """A reader at work.

    Attributes
    ----------
    folder : Path
    printed : str
        All that was printed so far.
    names : dict
        Of the Python blocks.
    started : list
        Programs in the background.
    others : bool
        Whether commands other than magpend's are executed.
    """

    folder: Path
    printed: str = ""
    names: dict[str, Any] = field(default_factory=dict)
    started: list[Any] = field(default_factory=list)
    others: bool = False

    def do(self, kind: str, about: str, language: str, text: str) -> None:
        """Do what a block says."""
        if kind == "file":
            name, _, quick = about.partition("; quick: ")
            more = "".join(f"{line.strip()}\n" for line in quick.split("|")) if quick else ""
            (self.folder / name).write_text(text + more, "utf-8")
        elif kind == "background":
            self.start(text.splitlines())
        elif kind == "printed":
            self.check(text)
        elif language == "python":
            with self.listening():
                exec(compile(text, "tutorial", "exec"), self.names)
        else:
            for line in re.sub(r"\\\n\s*", " ", text).splitlines():
                words = shlex.split(line, comments=True)
                if words and words[0] != "magpend" and self.others:
                    self.shell(line)
                elif words:
                    self.command(words)

    def command(self, words: list[str]) -> None:
        """Call a command of magpend, which must succeed."""
        from pipeline.cli.main import main

        if words[0] != "magpend":
            raise TutorialError(f"{words[0]}: only commands of magpend are run")
        if words[1] in ("run", "reproduce") and not {"--scheduler", "--dry-run"} & set(words):
            words = [*words, "--workers", "0"]
        before, sys.argv = sys.argv, words
        code: Any = 0
        try:
            with self.listening():
                main()
        except SystemExit as end:
            code = end.code
        finally:
            sys.argv = before
        if code:
            raise TutorialError(f"{shlex.join(words)}: exit code {code}\n{self.printed[-2000:]}")

    def shell(self, line: str) -> None:
        """Execute another command, which must succeed."""
        done = subprocess.run(["bash", "-c", line], cwd=self.folder, capture_output=True, text=True, check=False)
        self.printed += done.stdout + done.stderr
        if done.returncode:
            raise TutorialError(f"{line}: exit code {done.returncode}\n{self.printed[-2000:]}")

    def until(self, command: str, text: str) -> None:
        """Repeat a command until it prints a text."""
        until = time.monotonic() + PATIENCE_S
        while True:
            before = len(self.printed)
            with contextlib.suppress(TutorialError):  # there is no run directory yet, say
                self.do("run", "", "sh", command)
            if text in self.printed[before:]:
                return
            if time.monotonic() > until:
                raise TutorialError(f"{command}: did not print {text!r}\n{self.printed[-2000:]}")
            time.sleep(0.1)

    @contextlib.contextmanager
    def listening(self) -> Iterator[None]:
        """Be in the folder, and keep what is printed."""
        text, before = io.StringIO(), Path.cwd()
        os.chdir(self.folder)
        try:
            with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
                yield
        finally:
            os.chdir(before)
            self.printed += text.getvalue()

    def start(self, lines: list[str]) -> None:
        """Start programs, and wait for the files that a later one is told of."""
        places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
        packages = os.pathsep.join([str(DOCS.parent), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
        around = {**os.environ, "PATH": places, "PYTHONPATH": packages}
        for line in lines:
            words = shlex.split(line, comments=True)
            if self.started:
                self._wait([self.folder / word for word in words if word.endswith(".json")])
            self.started.append(
                subprocess.Popen(
                    words, cwd=self.folder, env=around, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
                )
            )

    def _wait(self, files: list[Path]) -> None:
        until = time.monotonic() + PATIENCE_S
        while not all(file.exists() for file in files):
            if time.monotonic() > until or self.started[-1].poll() is not None:
                raise TutorialError(f"{files[0].name}: did not appear")
            time.sleep(0.05)

    def check(self, text: str) -> None:
        """Find each line of a block among what was printed."""
        printed = self.printed.splitlines()
        for line in text.splitlines():
            if not any(alike(line, one) for one in printed):
                raise TutorialError(f"is not printed any more: {line!r}; but:\n{self.printed[-3000:]}")

    def end(self) -> None:
        """Stop what runs in the background, the last first."""
        for process in reversed(self.started):
            process.terminate()
        for process in self.started:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10.0)
            process.kill()
            process.wait()


def alike(shown: str, printed: str) -> bool:
    """Whether a line begins like another but for the spaces, numbers to a thousandth."""
    wanted, found = shown.split(), printed.split()[: len(shown.split())]
    return len(wanted) == len(found) and all(map(_same, wanted, found))


def _same(wanted: str, found: str) -> bool:
    if wanted == found:
        return True
    numbers, others = _NUMBER.findall(wanted), _NUMBER.findall(found)
    if len(numbers) != len(others) or _NUMBER.sub("", wanted) != _NUMBER.sub("", found):
        return False
    pairs = zip(map(float, numbers), map(float, others), strict=True)
    return all(math.isclose(a, b, rel_tol=1e-3, abs_tol=1e-9) for a, b in pairs)


def follow(page: Path, folder: Path, others: Collection[str] = ()) -> dict[str, Path]:
    """Do what a page says in a folder.

    Parameters
    ----------
    page, folder
    others
        Names of what there is for blocks that need it, such as ``slurm``; other named blocks are left out.

    Returns
    -------
    dict of Path
        By the page's own name of it, the file of each picture.

    Raises
    ------
    TutorialError
        If a command fails, prints something else, or a picture does not come.
    """
    text, session = page.read_text("utf-8"), Session(folder, others=bool(others))
    try:
        for command in _BEFORE.findall(text):
            session.do("run", "", "sh", command)
        for kind, about, language, block, until, where, command, printed in _BLOCK.findall(text):
            if until:
                if where in others:
                    session.until(command, printed)
            elif kind not in ("run", "printed") or not about or about in others:
                session.do(kind, about, language, block)
    finally:
        session.end()
    pictures = {shown: folder / made for made, shown in _PICTURE.findall(text)}
    if missing := [str(made) for made in pictures.values() if not made.is_file()]:
        raise TutorialError(f"{page.name}: no picture {', '.join(missing)}")
    return pictures


def keep(made: Path, kept: Path) -> None:
    """Copy a picture into the docs. Those of the gallery are shown together, and get a palette to be small."""
    from PIL import Image

    if kept.parent != GALLERY:
        kept.write_bytes(made.read_bytes())
        return
    with Image.open(made) as image:
        image.convert("RGB").quantize(COLOURS).save(kept, optimize=True)


def is_stale(kept: Path, made: Path) -> bool:
    """Whether a picture in the docs differs from one just made, in the first frame of films.

    A shade and half a percent of the pixels are let pass.
    """
    import numpy as np
    from PIL import Image

    if not kept.is_file():
        return True
    with Image.open(kept) as one, Image.open(made) as other:
        if one.size != other.size:
            return True
        shades = np.abs(np.asarray(one.convert("RGB"), int) - np.asarray(other.convert("RGB"), int))
    return bool((shades.max(axis=-1) > 32).mean() > 0.005)


def main() -> None:
    """Follow the pages that are named, or all."""
    words, n_stale, known = sys.argv[1:], 0, pages()
    for name in [word for word in words if word not in ("--pictures", "--check")] or known:
        with tempfile.TemporaryDirectory(prefix="magpend-tutorial-") as folder:
            begun = time.process_time()
            pictures = follow(known[name], Path(folder))
            print(f"{name}: {time.process_time() - begun:.1f} s of this process")
            for shown, made in pictures.items() if "--pictures" in words else ():
                keep(made, known[name].parent / shown)
                print(f"  {shown}: {(known[name].parent / shown).stat().st_size / 1000:.0f} kB")
            for shown, made in pictures.items() if "--check" in words else ():
                if is_stale(known[name].parent / shown, made):
                    n_stale += 1
                    print(f"  {shown}: stale; make it with: python docs/run_tutorials.py --pictures {name}")
    sys.exit(1 if n_stale else 0)


if __name__ == "__main__":
    sys.path.insert(0, str(DOCS.parent))
    sys.path.insert(0, str(DOCS.parent / "pipeline" / "face"))
    main()
