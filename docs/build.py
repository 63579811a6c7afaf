"""Build the site: ``python docs/build.py [--copies] [FOLDER]``, by default into ``build/site``.

With ``--copies`` each page of the gallery gets a copy of the explorer with the page's run, in one file. The runs are
computed in ``build/gallery``, which takes some minutes; complete ones are used again.

Each page of the gallery gets its notebook, by `docs/notebooks.py`.

Warnings are errors, broken links within the docs among them. Then the built pages are read: nothing in them
may be loaded from elsewhere.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path

DOCS = Path(__file__).resolve().parent

_LOADED = re.compile(
    r"""<(?:script|img|iframe|source|video|audio|embed|object)\b[^>]*\b(?:src|data|srcset)=["']?\s*((?:https?:)?//[^"'\s>]+)"""
    r"""|<link\b(?=[^>]*\brel=["']?(?:stylesheet|preload|icon|preconnect|dns-prefetch|modulepreload|shortcut))[^>]*\bhref=["']?((?:https?:)?//[^"'\s>]+)"""
    r"""|url\(\s*["']?((?:https?:)?//[^"')\s]+)|@import\s+["']((?:https?:)?//[^"']+)""",
    re.IGNORECASE,
)


def build(folder: Path) -> int:
    """Build all pages; returns Sphinx's exit code."""
    from sphinx.cmd.build import main

    words = ["-q", "-W", "--keep-going", "-b", "html", "-d", str(folder.parent / "doctrees")]
    return main([*words, str(DOCS), str(folder)])


def copies(runs: Path, figures: Sequence[str] = (), *, smoke: bool = False) -> Path:
    """Compute the runs of the gallery, and export each as a copy of the explorer; returns the copies' folder."""
    from pipeline.explorer.copies.export import export_page
    from pipeline.report.reproduce import reproduce
    from pipeline.report.study import load_study
    from pipeline.store.run import RunDirectory

    done = reproduce(load_study("gallery"), runs, figures=figures, smoke=smoke, workers=0)
    folder = done.folder / "copies"
    folder.mkdir(exist_ok=True)
    for place in sorted((done.folder / "runs").iterdir()):
        export_page(RunDirectory.open(place), folder / f"{place.name}.html", force=True)
    return folder


def loaded_from_elsewhere(folder: Path) -> list[str]:
    """Return what pages and styles load from other hosts, each with its file."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.suffix in (".html", ".css"):
            for match in _LOADED.finditer(path.read_text("utf-8")):
                found.append(f"{path.relative_to(folder)}: {next(filter(None, match.groups()))}")
    return found


def main() -> None:
    """Build, look, and say what was built."""
    words = [word for word in sys.argv[1:] if word != "--copies"]
    folder = Path(words[0] if words else DOCS.parent / "build" / "site").resolve()
    begun, made = time.perf_counter(), None
    if "--copies" in sys.argv:
        made = copies(folder.parent / "gallery")
        os.environ["MAGPEND_DOCS_COPIES"] = str(made)
    if code := build(folder):
        sys.exit(code)
    for page in sorted(made.iterdir()) if made else ():
        shutil.copyfile(page, folder / "gallery" / f"{page.stem}-explorer.html")
    if foreign := loaded_from_elsewhere(folder):
        sys.exit("loaded from elsewhere:\n  " + "\n  ".join(foreign))
    pages = sum(1 for _ in folder.rglob("*.html"))
    print(f"{pages} pages in {time.perf_counter() - begun:.0f} s: {folder / 'index.html'}")


if __name__ == "__main__":
    sys.path.insert(0, str(DOCS.parent))
    main()
