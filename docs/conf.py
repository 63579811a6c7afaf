"""The site: Sphinx over the Markdown of this folder, which is readable without it; see `docs/build.py`."""

from __future__ import annotations

import os
import re
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent / "pipeline" / "face"), str(HERE.parent), str(HERE)]

project = "magpend"
author = "the magpend authors"
project_copyright = "the magpend authors, MIT licence"
version = release = metadata.version("magpend")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
root_doc = "index"

myst_heading_anchors = 4
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
autodoc_typehints = "none"
default_role = "code"
pygments_style = "friendly"

html_theme = "furo"
html_title = "magpend"
html_copy_source = False
html_show_sphinx = False
html_static_path = ["site"]
html_css_files = ["magpend.css"]
html_favicon = "site/favicon.svg"
html_theme_options = {"navigation_with_keys": True}
html_permalinks_icon = "#"

COPIES = os.environ.get("MAGPEND_DOCS_COPIES", "")
"""Folder of the explorer's copies that `docs/build.py --copies` makes: NAME.html for each page of the gallery."""

TOP = {"changelog": "CHANGELOG.md", "contributing": "CONTRIBUTING.md", "programs": "AGENTS.md"}
"""Pages whose text is a file at the top of the repository."""

GROUPS = {
    "Runs": ("run", "state", "open_run", "Run", "verify_run", "extend", "zoom", "Status", "SpecError", "show_versions"),
    "Analyses": ("derive", "prune"),
    "Figures and animations": (
        "figure",
        "draw_figure",
        "animation",
        "save_figure",
        "save_animation",
        "save_data",
        "DataFigure",
        "Frame",
    ),
    "Models and parameters": (
        "load_model",
        "import_object",
        "import_model",
        "model_names",
        "Model",
        "System",
        "load_preset",
        "preset_names",
        "write_preset",
        "Parameters",
        "ParameterError",
    ),
    "Integration": (
        "sections",
        "Sections",
        "run_branches",
        "trajectory",
        "simulate",
        "evaluate",
        "rates",
        "jacobian",
        "polish_orbits",
        "PeriodicOrbits",
        "lyapunov_exponents",
        "LyapunovExponents",
    ),
    "Recordings and rigs": (
        "read_recording",
        "load_mapping",
        "findings_of",
        "smooth",
        "window",
        "write_recording",
        "load_drive",
        "Drive",
        "recorded_sections",
        "recorded_trajectory",
        "evaluate_recorded",
        "identify",
    ),
}
"""Names of the public face by what they are for; analyses and plots join their groups, others end in one."""


def grouped() -> dict[str, list[str]]:
    """Return every name of `import magpend`, by group."""
    import magpend
    from pipeline.products.registry import ANALYSES

    found = {group: list(names) for group, names in GROUPS.items()}
    found["Analyses"] += ANALYSES.listed
    placed = {name for names in found.values() for name in names}
    left = [n for n in dir(magpend) if not n.startswith("_") and n not in placed]
    found["Figures and animations"] += [n for n in left if n.startswith("plot_")]
    found["More"] = [n for n in left if not n.startswith("plot_")]
    return found


def _docstrings() -> str:
    """Directives that show the docstrings, as MyST takes them."""
    import magpend
    from pipeline.products.registry import ANALYSES

    # methods for analyses are shown as functions
    shown = {"Run": f"   :members:\n   :exclude-members: {', '.join(ANALYSES.listed)}\n", "Spec": "   :members:\n"}
    parts = []
    for group, names in grouped().items():
        parts.append(f"## {group}\n")
        for name in names:
            thing = getattr(magpend, name)
            kind = "exception" if isinstance(thing, type) and issubclass(thing, BaseException) else "class"
            kind = kind if isinstance(thing, type) else "function"
            parts.append(f"```{{eval-rst}}\n.. auto{kind}:: magpend.{name}\n{shown.get(name, '')}```\n")
    parts.append("## Figures of a run\n\n```{eval-rst}\n.. autoclass:: magpend._plots.Plots\n   :members:\n```\n")
    parts.append("## Datasets\n\n```{eval-rst}\n.. autoclass:: magpend._accessor.DatasetAccessor\n   :members:\n```\n")
    return "\n".join(parts)


def _navigation(text: str) -> str:
    """Trees of pages, from the lists under the headings of the first page."""
    trees = []
    for heading, body in re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", text, re.DOTALL | re.MULTILINE):
        pages = re.findall(r"^- \[([^\]]+)\]\(([\w/-]+)\.md\)", body, re.MULTILINE)
        rows = "\n".join(f"{title} <{page}>" for title, page in pages)
        if rows:
            trees.append(f"```{{toctree}}\n:hidden:\n:caption: {heading}\n\n{rows}\n```\n")
    return "\n".join(trees)


def _read(app: Any, page: str, source: list[str]) -> None:
    """Complete what Markdown by itself cannot say: navigation, docstrings, files elsewhere."""
    text = source[0]
    if page == "index":
        text += "\n" + _navigation(text)
    if page == "reference/api":
        text = text.replace("<!-- docstrings -->", _docstrings())
    folder, _, name = page.partition("/")
    if folder == "gallery" and COPIES and (Path(COPIES) / f"{name}.html").is_file():
        text += f'\n<p><a href="{name}-explorer.html">Explore this run</a>: a copy of the explorer, one file.</p>\n'
    if folder == "gallery":
        text += f'\n<p><a href="{name}.ipynb" download>This page as a notebook</a>, to execute and change.</p>\n'
    if page in TOP:
        # their links are seen from the top of the repository
        text = (HERE.parent / TOP[page]).read_text("utf-8").replace("](docs/", "](")
        for target, name in TOP.items():
            text = text.replace(f"]({name})", f"]({target}.md)")
    up = "../" * page.count("/")
    for target, name in (*TOP.items(), ("index", "README.md")):
        text = text.replace(f"]({up}../{name})", f"]({up}{target}.md)")
    source[0] = text


def _write_notebooks(app: Any, error: Exception | None) -> None:
    """Write the gallery's notebooks beside its pages."""
    from notebooks import write_notebooks

    if error is None:
        write_notebooks(HERE / "gallery", Path(app.outdir) / "gallery")


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("source-read", _read)
    app.connect("build-finished", _write_notebooks)
