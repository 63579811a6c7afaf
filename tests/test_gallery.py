"""The gallery of published figures: each entry is complete, and some are computed and judged as their pages say.

All are computed with MAGPEND_LONG=1.
"""

from __future__ import annotations

import math
import re

import pytest

from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.report.report import command_of
from pipeline.report.study import load_study
from pipeline.specification.files import find_spec, shipped_workflows
from pipeline.specification.problems import validated
from pipeline.specification.spec import Spec
from tests.programs import ROOT, program

PAGES = ROOT / "docs" / "gallery"


tutorials = program("docs/run_tutorials.py")
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
