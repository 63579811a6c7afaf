"""Build the site: ``python docs/build.py [FOLDER]``, by default into ``build/site``.

Warnings are errors, broken links within the docs among them. Then the built pages are read: nothing in them
may be loaded from elsewhere.
"""

from __future__ import annotations

import re
import sys
import time
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
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else DOCS.parent / "build" / "site").resolve()
    begun = time.perf_counter()
    if code := build(folder):
        sys.exit(code)
    if foreign := loaded_from_elsewhere(folder):
        sys.exit("loaded from elsewhere:\n  " + "\n  ".join(foreign))
    pages = sum(1 for _ in folder.rglob("*.html"))
    print(f"{pages} pages in {time.perf_counter() - begun:.0f} s: {folder / 'index.html'}")


if __name__ == "__main__":
    main()
