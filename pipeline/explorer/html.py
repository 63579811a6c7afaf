"""Write the HTML of the page, for the server and for copies with the data in the page or in files of a folder."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from html import escape
from importlib import resources

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
{policy}<meta name="viewport" content="width=device-width, initial-scale=1">
{generator}<title>{title}</title>
<link rel="icon" href="data:,">
{style}
</head>
<body>
<div id="app" data-mode="{mode}"{about}></div>
<noscript>This page draws with a script of its own; nothing of it comes from elsewhere.</noscript>
{data}{script}
</body>
</html>
"""

_NOTE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>magpend</title>
</head>
<body>
<h1>magpend explore</h1>
<p>{sentence}</p>
</body>
</html>
"""

_DATA = '<script type="application/octet-stream;base64" id="data-{name}">{content}</script>\n'


def static_text(name: str) -> str:
    """Return the text of a file in ``static/``, which has the built scripts and styles of the page."""
    return resources.files("pipeline.explorer").joinpath("static", name).read_text("utf-8")


def note_html(sentence: str) -> str:
    """Return the HTML of a page that shows one sentence."""
    return _NOTE.format(sentence=escape(sentence))


def served_html(title: str, token: str) -> str:
    """Return the HTML of a run's page, which sends the secret token with every request."""
    return _PAGE.format(
        policy="",
        generator="",
        title=escape(f"{title} - magpend"),
        style='<link rel="stylesheet" href="static/explorer.css">',
        mode="server",
        about=f' data-token="{escape(token)}"',
        data="",
        script='<script src="static/explorer.js"></script>',
    )


def inline_html(title: str, generator: str, objects: Mapping[str, bytes]) -> str:
    """Return the HTML of a page that contains its data and makes no requests."""
    data = "".join(
        _DATA.format(name=escape(name), content=base64.b64encode(content).decode()) for name, content in objects.items()
    )
    return _copied("inline", title, generator, "explorer.js", "'none'", data=data)


def folder_html(title: str, generator: str, list_sha256: str) -> str:
    """Return the HTML of the page of a folder export; it has the digest of ``objects.json``, the list of data files."""
    return _copied("folder", title, generator, "explorer-folder.js", "'self'", f' data-objects="{list_sha256}"')


def _copied(
    mode: str, title: str, generator: str, script_name: str, connect: str, about: str = "", data: str = ""
) -> str:
    script, style = static_text(script_name), static_text("explorer.css")
    for text, end in ((script, "</script"), (style, "</style")):
        if end in text.lower():
            raise ValueError(f"the built page holds {end}, which would end it: build it again")
    policy = (
        f"default-src 'none'; script-src {_digest(script)}; style-src {_digest(style)}; img-src data: blob:; "
        f"connect-src {connect}; worker-src blob:; base-uri 'none'; form-action 'none'"
    )
    return _PAGE.format(
        policy=f'<meta http-equiv="Content-Security-Policy" content="{escape(policy)}">\n',
        generator=f'<meta name="generator" content="{escape(generator)}">\n',
        title=escape(f"{title} - magpend"),
        style=f"<style>{style}</style>",
        mode=mode,
        about=about,
        data=data,
        script=f"<script>{script}</script>",
    )


def _digest(text: str) -> str:
    """Return the SHA-256 of a text in the form that a page's content security policy needs."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
