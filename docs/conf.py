"""The site: Sphinx over the Markdown of this folder, which is readable without it. Built by `docs/build.py`."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "pipeline" / "face"))
sys.path.insert(0, str(HERE.parent))

project = "magpend"
author = "the magpend authors"
project_copyright = "the magpend authors, MIT licence"
version = release = metadata.version("magpend")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "**/.ipynb_checkpoints"]
suppress_warnings = ["myst.xref_missing"] if False else []
nitpicky = False

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
napoleon_google_docstring = False
autodoc_typehints = "none"
default_role = "code"

html_theme = "furo"
html_title = "magpend"
html_copy_source = False
html_show_sphinx = False
html_show_sourcelink = False
