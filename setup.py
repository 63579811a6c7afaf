"""Say in a sentence what to do where Python is too old; pip names the version alone. All else is in pyproject.toml."""

import sys

if sys.version_info < (3, 11):
    sys.exit(
        "magpend needs Python 3.11 or later, and this is %d.%d: make the environment with a newer one "
        "(python3.12 -m venv .venv), or let uv fetch it (uvx --from . magpend run quickstart --plot)."
        % sys.version_info[:2]
    )

from setuptools import setup

setup()
