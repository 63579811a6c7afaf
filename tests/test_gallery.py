"""The gallery of published figures: each entry is complete, and some are computed and judged as their pages say.

All are computed with MAGPEND_LONG=1.
"""

from __future__ import annotations

import math
import os
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq

from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.report.report import command_of
from pipeline.report.study import load_study
from pipeline.specification.files import find_spec, shipped_workflows
from pipeline.specification.problems import validated
from pipeline.specification.spec import Spec
from tests.core import collocation
from tests.programs import ROOT, program

PAGES = ROOT / "docs" / "gallery"


tutorials = program("docs/run_tutorials.py")
notebooks = program("docs/notebooks.py")
STUDY = load_study("gallery")
FIGURE = {figure.number: figure for figure in STUDY.table.figures}
QUICK = ("josephson-steps", "ueda-coexisting")
"""Figures that every test run computes. Each takes some seconds, and other tests compile their systems."""
LARGEST_PICTURE = 60_000
A_PAGE = 100
"""Most lines of a specification."""


def test_gallery__each_figure_has_a_specification_a_page_and_a_run():
    specs = {name.partition("/")[2] for name in shipped_workflows() if "/" in name}
    assert set(FIGURE) == {page.stem for page in PAGES.glob("*.md")}
    assert set(FIGURE) <= specs == set(STUDY.table.runs)
    # a figure may need a second run, which begins with its name
    assert all(any(name.startswith(figure) for figure in FIGURE) for name in specs)


@pytest.mark.parametrize("name", FIGURE)
def test_gallery__specification_names_paper_figure_and_number(name):
    path = find_spec(f"gallery/{name}")
    text = path.read_text("utf-8")
    head = text.partition("kind =")[0]
    assert len(text.splitlines()) <= A_PAGE
    assert all(line.startswith("#") for line in head.splitlines())
    for word in ("Paper:", "Figure:", "Number:"):
        assert word in head, word
    Spec.read(path, smoke=True)
    assert STUDY.table.runs[name].spec == path.name
    # claims are bounded, and their options exist
    figure = FIGURE[name]
    assert figure.source
    assert figure.pictures
    assert figure.claims
    for claim in figure.claims:
        assert claim.source
        assert any(map(math.isfinite, claim.range)), claim.statement
        assert not claim.calibrated, claim.statement
        if "analysis" in claim.options:
            validated(ANALYSES[claim.options["analysis"]].options, claim.options.get("with", {}))


@pytest.mark.parametrize("name", FIGURE)
def test_gallery__page_draws_the_study_s_figure(name):
    text = (PAGES / f"{name}.md").read_text("utf-8")
    picture = FIGURE[name].pictures[0]
    commands = [line.split("  #")[0].strip() for line in text.replace("\\\n", " ").splitlines()]
    commands = [" ".join(line.split()) for line in commands]
    drawn = command_of(f"plot {picture.figure}", picture.options, f"reproduce/gallery/runs/{name}")
    assert f"magpend reproduce gallery --figure {name}" in commands
    assert f"{drawn} --width 85 --out {name}.png" in commands
    assert (PAGES / f"{name}.png").stat().st_size < LARGEST_PICTURE
    assert f"gallery/{name}.toml" in text
    index = (ROOT / "docs" / "index.md").read_text("utf-8")
    assert re.search(rf"\[!\[[^\]]+\]\(gallery/{name}\.png\)\]\(gallery/{name}\.md\)", index)
    assert picture.figure in FIGURES


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.long]) for name in FIGURE]
)
def test_gallery__page_prints_the_verdicts(name, tmp_path, monkeypatch):
    """Computes the figure; its page has each claim with its number and verdict, and the picture."""
    monkeypatch.chdir(tmp_path)
    page = PAGES / f"{name}.md"
    for shown, made in tutorials.follow(page, tmp_path).items():
        assert not tutorials.is_stale(page.parent / shown, made)
    printed = re.search(r"<!-- printed -->\n```text\n(.*?)```", page.read_text("utf-8"), re.DOTALL).group(1)
    assert sum(line.startswith(f"{name} ") for line in printed.splitlines()) == len(FIGURE[name].claims)


@pytest.mark.slow
def test_copies__a_page_links_to_its_copy_of_the_explorer(tmp_path, monkeypatch):
    build = program("docs/build.py")
    folder = build.copies(tmp_path / "gallery", ["ueda-coexisting"], smoke=True)
    (copy,) = folder.iterdir()
    assert copy.name == "ueda-coexisting.html"
    assert not build.loaded_from_elsewhere(folder)
    monkeypatch.setenv("MAGPEND_DOCS_COPIES", str(folder))
    conf = program("docs/conf.py")
    for page, there in (("gallery/ueda-coexisting", True), ("gallery/belt-friction", False), ("index", False)):
        source = ["text"]
        conf._read(None, page, source)
        assert ('href="ueda-coexisting-explorer.html"' in source[0]) == there


def test_site__each_gallery_page_links_to_its_notebook(tmp_path):
    conf = program("docs/conf.py")
    for page, has_link in (("gallery/belt-friction", True), ("index", False)):
        source = ["text"]
        conf._read(None, page, source)
        assert ('href="belt-friction.ipynb"' in source[0]) == has_link
    (tmp_path / "gallery").mkdir()
    conf._write_notebooks(SimpleNamespace(outdir=tmp_path), None)
    assert {path.stem for path in (tmp_path / "gallery").iterdir()} == set(FIGURE)


@pytest.mark.parametrize("name", FIGURE)
def test_notebook__has_the_page_s_commands_texts_and_specification(name):
    page = PAGES / f"{name}.md"
    made = notebooks.notebook_of(page)
    sources = {kind: [c["source"] for c in made["cells"] if c["cell_type"] == kind] for kind in ("code", "markdown")}
    text = page.read_text("utf-8")
    commands = re.search(r"```sh\n(.*?)```", text, re.DOTALL).group(1).replace("\\\n", " ")
    lines = [" ".join(line.split()) for line in commands.splitlines() if line.strip()]
    assert sources["code"][1].replace("!", "").splitlines() == lines
    assert sources["code"][2] == f'Image("{name}.png")'
    whole = "\n".join(sources["markdown"])
    assert "<!--" not in whole
    assert "](.." not in whole  # nothing of the repository lies beside it
    printed = re.search(r"<!-- printed -->\n(```text\n.*?```)", text, re.DOTALL).group(1)
    assert printed in whole
    system = re.search(r"^\*\*The system\.\*\*.*?(?=\n\n)", text, re.DOTALL | re.MULTILINE).group(0)
    assert system.partition("[")[0] in whole
    assert f"**{name}.toml**\n\n```toml\n{find_spec(f'gallery/{name}').read_text('utf-8')}```" in whole


def test_notebook__is_one_that_jupyter_reads(tmp_path):
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
    written = notebooks.write_notebooks(PAGES, tmp_path)
    assert {path.stem for path in written} == set(FIGURE)
    for path in written:
        nbformat.validate(nbformat.read(path, as_version=4))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else [pytest.mark.long]) for name in FIGURE]
)
def test_notebook__executed_it_prints_and_draws_what_the_page_shows(name, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    nbformat = pytest.importorskip("nbformat")
    # a magpend of this checkout, after the one of the kernel's Python
    script = tmp_path / "bin" / "magpend"
    script.parent.mkdir()
    script.write_text(f"#!{sys.executable}\nfrom pipeline.cli.entry import main\n\nmain()\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{script.parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]))
    made = nbformat.from_dict(notebooks.notebook_of(PAGES / f"{name}.md"))
    resources = {"metadata": {"path": str(tmp_path)}}
    done = nbclient.NotebookClient(made, timeout=600, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in done.cells if cell.cell_type == "code" for output in cell.outputs]
    seen = "".join(output.text for output in outputs if output.output_type == "stream").splitlines()
    text = (PAGES / f"{name}.md").read_text("utf-8")
    printed = re.search(r"<!-- printed -->\n```text\n(.*?)```", text, re.DOTALL).group(1).splitlines()
    assert [line for line in printed if not any(tutorials.alike(line, one) for one in seen)] == []
    assert [output for output in outputs if "image/png" in output.get("data", {})]
    assert not tutorials.is_stale(PAGES / f"{name}.png", tmp_path / f"{name}.png")


# ---- numbers computed apart --------------------------------------------------------------------------------


def claimed(figure, words):
    (found,) = (claim.expected for claim in FIGURE[figure].claims if words in claim.statement)
    return found


def axon_gates(v):
    """Opening and closing rates of Hodgkin and Huxley's gates m, h and n [1/ms], of the depolarisation [mV]."""

    def ratio(u):
        return np.divide(u, np.expm1(u), out=np.ones_like(u), where=u != 0.0)

    return (
        (ratio((25 - v) / 10), 4 * np.exp(-v / 18)),
        (0.07 * np.exp(-v / 20), 1 / (1 + np.exp((30 - v) / 10))),
        (0.1 * ratio((10 - v) / 10), 0.125 * np.exp(-v / 80)),
    )


def axon(state, current):
    v, m, h, n = state
    leak = 120 * m**3 * h * (v - 115) + 36 * n**4 * (v + 12) + 0.3 * (v - 10.599)
    return np.array(
        [current - leak, *(a * (1 - x) - b * x for x, (a, b) in zip(state[1:], axon_gates(v), strict=True))]
    )


def axon_at_rest(v):
    """State at rest with a depolarisation, and the current that holds it."""
    state = np.array([v, *(a / (a + b) for a, b in axon_gates(v))])
    return state, -axon(state, 0.0)[0]


def axon_at_hopf(low, high):
    """State and current at which Hurwitz's determinant of order three vanishes, between two depolarisations."""

    def determinant(v):
        state, current = axon_at_rest(v)
        rows = [(axon(state + step, current) - axon(state - step, current)) / 2e-5 for step in 1e-5 * np.eye(4)]
        _, a, b, c, d = np.poly(np.transpose(rows))
        return a * b * c - c * c - a * a * d

    return axon_at_rest(brentq(determinant, low, high, xtol=1e-13))


def test_claims__hopf_points_of_the_axon():
    for words, low, high in (("Rest loses", 4.0, 7.0), ("Firing ends", 20.0, 23.0)):
        _, current = axon_at_hopf(low, high)
        assert current == pytest.approx(claimed("hodgkin-huxley", words), abs=1e-5), words


@pytest.mark.slow
def test_claims__folds_and_doublings_of_the_axon():
    """By collocation, from the Hopf point on; on the way cycles grow like a canard, and a multiplier passes 6e8."""
    unit = np.array([100.0, 1.0, 1.0, 1.0])

    def rates(y, current):
        return axon(y * unit[:, None], current) / unit[:, None]

    state, current = axon_at_hopf(4.0, 7.0)
    found = {"folds": [], "doublings": []}
    first = collocation.near_hopf(rates, state / unit, current, size=1e-3, n_intervals=80)
    for orbit, following in collocation.branch(rates, first, 0.01, 0.1, 60):
        tests = {"folds": collocation.is_turning, "doublings": collocation.is_doubling(rates, orbit)}
        for kind, function in tests.items():
            if there := collocation.located(rates, orbit, following, function):
                found[kind].append(there.parameter)
    # the same with 160 intervals in place of 80, to 3e-9 and better
    assert found["folds"] == pytest.approx([7.84654712019, 7.92198549435, 6.26452127452], abs=4e-9)
    assert found["doublings"] == pytest.approx([7.84953739785, 7.92197767573], abs=4e-9)
    claims = [claimed("hodgkin-huxley", words) for words in ("turn back", "cycles turn at", "Firing begins")]
    assert found["folds"] == pytest.approx(claims, abs=5e-5)
    assert found["doublings"][1] == pytest.approx(claimed("hodgkin-huxley", "they double"), abs=1e-6)


def test_claims__hopf_points_of_the_oregonator():
    """Hurwitz's condition, at the positive root of -q x^2 + (1 - q - f) x + 1 + f."""
    s, q, w = 77.27, 8.375e-6, 0.161

    def determinant(f):
        x = max(np.roots([-q, 1.0 - q - f, 1.0 + f]))
        y = f * x / (1.0 + x)
        jacobian = [[s * (1.0 - y - 2.0 * q * x), s * (1.0 - x), 0.0], [-y / s, -(1.0 + x) / s, f / s], [w, 0.0, -w]]
        _, a, b, c = np.poly(jacobian)
        return a * b - c

    for words, low, high in (("unstable", 0.4, 0.6), ("stable again", 1.4, 1.6)):
        assert brentq(determinant, low, high, xtol=1e-14) == pytest.approx(claimed("oregonator", words), abs=5e-8), (
            words
        )
