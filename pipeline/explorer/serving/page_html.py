"""Write the HTML of the page that the explorer serves."""

from __future__ import annotations

from html import escape

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="static/explorer.css">
</head>
<body>
<div id="app" data-mode="server" data-token="{token}"></div>
<noscript>This page draws with a script of its own; nothing of it comes from elsewhere.</noscript>
<script src="static/explorer.js"></script>
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


def page(title: str, token: str) -> str:
    """Return the HTML of a run's page, which sends the secret token with every request."""
    return _PAGE.format(title=escape(f"{title} - magpend"), token=escape(token))


def note(sentence: str) -> str:
    """Return the HTML of a page that shows one sentence."""
    return _NOTE.format(sentence=escape(sentence))
