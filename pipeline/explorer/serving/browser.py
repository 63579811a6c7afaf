"""Open the page in a browser by a private file that redirects to it, so that the secret token is on no command line."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path

_REDIRECT = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="refresh" content="0; url={address}">
<meta name="referrer" content="no-referrer">
<title>magpend</title>
</head>
<body><a href="{address}">magpend explore</a></body>
</html>
"""


def redirect_file(folder: Path, address: str) -> Path:
    """Write a file that redirects a browser to an address, and that only this user can read."""
    path = folder / "open.html"
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(_REDIRECT.format(address=escape(address)))
    return path


@contextlib.contextmanager
def browser() -> Iterator[Callable[[str], None]]:
    """Yield a function that opens an address in the user's browser without waiting for it.

    The redirect file exists as long as the block runs.
    """
    folder = Path(tempfile.mkdtemp(prefix="magpend-explore-"))

    def open_address(address: str) -> None:
        path = redirect_file(folder, address)
        threading.Thread(target=webbrowser.open, args=(path.as_uri(),), daemon=True, name="browser").start()

    try:
        yield open_address
    finally:
        shutil.rmtree(folder, ignore_errors=True)
