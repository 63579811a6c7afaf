"""Progress in plain lines, and as a bar in a notebook."""

from __future__ import annotations

from pipeline.products.reporting import is_heard
from pipeline.runs import progress as notebook
from pipeline.runs.progress import LINE_EVERY_S, Progress


def test_progress__rate_and_time_left_count_this_session_only():
    now = [0.0]
    lines: list[str] = []
    with Progress(1000, 500, terminal=False, echo=lines.append, clock=lambda: now[0]) as progress:
        progress.add(10)
        assert lines == []
        now[0] = LINE_EVERY_S
        progress.add(90)
        assert lines == ["600/1000 cells (60 %), 10 cells/s, 40 s left"]
        progress.add(400)
    assert lines[-1].startswith("1000/1000 cells (100 %)")


def test_progress__bar(capsys):
    with Progress(10, 0, terminal=True, echo=print) as progress:
        progress.add(10)
    shown = capsys.readouterr()
    assert "10/10" in shown.out + shown.err


def test_progress__outside_a_notebook_does_nothing(capsys):
    assert not notebook.is_notebook()
    with notebook.bar_in_notebook():
        assert not is_heard()
    assert capsys.readouterr() == ("", "")


def test_bar__shows_counts_then_how_it_ended():
    bar = notebook.Bar()
    bar._show = lambda: None
    assert repr(bar) == ""
    bar("compiling", 0, 0)
    assert "<progress  style" in bar._repr_html_()
    bar("computing cells", 10, 40)
    assert repr(bar).startswith("computing cells: 10 of 40 (25 %)")
    bar.end("stopped")
    assert repr(bar).startswith("computing cells: 10 of 40 (25 %), stopped after")
