"""Open the page in a browser without showing its address to others: arguments of processes are no secret."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import threading
import webbrowser
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


def redirect_file(address: str) -> Path:
    """Write a file, for this user alone, that leads a browser to an address; it goes with the process."""
    folder = Path(tempfile.mkdtemp(prefix="magpend-explore-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    path = folder / "open.html"
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(_REDIRECT.format(address=escape(address)))
    return path


def open_browser(address: str) -> None:
    """Open an address in the person's browser, if there is one; the server does not wait for it."""
    path = redirect_file(address)
    threading.Thread(target=webbrowser.open, args=(path.as_uri(),), daemon=True, name="browser").start()
