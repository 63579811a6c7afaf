"""The page itself: texts stay texts, it needs nothing beside itself, verdicts follow from intervals."""

from __future__ import annotations

import math
import re

import pytest

from pipeline.report.estimates import Verdict, judged
from pipeline.report.page import ROWS_OF_PAGE, Facts, Grid, Note, Outcome, Page, Part, Picture, Source, grid_of, render

HOSTILE = "</title><script>alert('x')</script><img src=http://e.org/x onerror=alert(1)> & \"q\""


def page_of(text: str) -> Page:
    outcome = Outcome(text, text, text, Verdict.MET, text, True, text)
    blocks = [
        Picture(b"\x89PNG", 3, 2, text, text, text),
        Grid([text], [[text]], text, text, 4),
        Note(text, text),
        Facts({text: text}),
        Source(text, text),
        outcome,
    ]
    return Page(text, blocks, [Part(text, blocks, [Part(text, blocks)]), Part("two", [])], text)


def test_render__texts_stay_texts():
    html = render(page_of(HOSTILE))
    assert "<script" not in html
    assert "&lt;script&gt;" in html
    tags = re.findall(r"<(img|a|link|form|iframe|object)\b([^>]*)>", html)
    assert all("onerror" not in attributes.split("alt=")[0] for _, attributes in tags)
    assert all(re.search(r'src="data:', attributes) for tag, attributes in tags if tag == "img")
    assert all(re.search(r'href="#', attributes) for tag, attributes in tags if tag == "a")
    same = render(page_of(HOSTILE))
    assert html == same


def test_render__asks_nothing_of_a_network():
    html = render(page_of("plain"))
    assert not re.search(r"https?://|//[a-z]|@import|url\(", html)
    assert "default-src 'none'" in html


@pytest.mark.parametrize(
    ("interval", "claim", "verdict"),
    [
        ((0.24, 0.26), (0.2, 0.3), Verdict.MET),
        ((0.19, 0.26), (0.2, 0.3), Verdict.UNDECIDED),
        ((0.1, 0.19), (0.2, 0.3), Verdict.NOT_MET),
        ((0.31, 0.4), (0.2, 0.3), Verdict.NOT_MET),
        ((0.1, 0.4), (0.2, 0.3), Verdict.UNDECIDED),
        ((1.0, 9.0), (0.2, math.inf), Verdict.MET),
        ((math.nan, math.nan), (0.2, 0.3), Verdict.UNDECIDED),
    ],
)
def test_judged__the_whole_interval_decides(interval, claim, verdict):
    assert judged(*interval, *claim) is verdict


def test_grid_of__rows():
    grid = grid_of([{"a_b": 1.23456789, "none": math.nan}, {"a_b": 2, "c": True}] * 40)
    assert grid.columns == ["a b", "c"]
    assert list(grid.rows) == [["1.23457", ""], ["2", "yes"]] * (ROWS_OF_PAGE // 2)
    assert grid.n_more == 80 - ROWS_OF_PAGE
