"""The tutorials as a reader follows them: what is typed, printed and drawn there is done here."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

import pytest
from PIL import Image

from tests.programs import ROOT, program

tutorials = program("docs/run_tutorials.py")
slurm = program("tests/pipeline/runs/slurm.py")
FRESH = (
    "van-der-pol",
    "python-start",
    "response",
    "events",
    "spectra",
    "beside-other-tools",
    "maps",
    "henon",
    "branches",
)
"""Pages whose pictures are compared as well."""
PAGES = {**tutorials.PAGES, **{name: tutorials.pages()[name] for name in FRESH}, "AGENTS": ROOT / "AGENTS.md"}


@pytest.fixture
def others(name, monkeypatch):
    """Start a SLURM for a page with blocks that need one, if there can be one here."""
    if "<!-- run: slurm -->" not in PAGES[name].read_text("utf-8") or slurm.why_not():
        yield ()
        return
    monkeypatch.delenv("MAGPEND_CLUSTER", raising=False)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep))
    # a socket's name has at most 108 letters, which pytest's own folder can use up
    with tempfile.TemporaryDirectory(prefix="slurm-") as folder, slurm.running(Path(folder)) as variables:
        for variable, value in variables.items():
            monkeypatch.setenv(variable, value)
        yield ("slurm",)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAGES)
def test_tutorial__does_what_it_says(name, others, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = PAGES[name]
    for shown, made in tutorials.follow(page, tmp_path, others).items():
        kept = page.parent / shown
        assert kept.is_file(), f"make it with: python docs/run_tutorials.py --pictures {name}"
        with Image.open(kept) as one, Image.open(made) as other:
            assert one.size == other.size
            assert getattr(one, "n_frames", 1) == getattr(other, "n_frames", 1)
        assert name not in FRESH or not tutorials.is_stale(kept, made)


def test_is_stale__tells_a_changed_picture(tmp_path):
    """A line of 1 % of the pixels is seen, a shade is not."""
    for name, shade, line in (("kept", 255, 0), ("shaded", 250, 0), ("drawn", 255, 1)):
        image = Image.new("RGB", (100, 100), (shade,) * 3)
        image.paste((0, 0, 0), (0, 0, 100, line))
        image.save(tmp_path / f"{name}.png")
    kept = tmp_path / "kept.png"
    assert not tutorials.is_stale(kept, kept)
    assert not tutorials.is_stale(kept, tmp_path / "shaded.png")
    assert tutorials.is_stale(kept, tmp_path / "drawn.png")
    assert tutorials.is_stale(tmp_path / "gone.png", kept)


@pytest.mark.slow
def test_first_motion__is_what_its_command_draws(tmp_path, command):
    """The motion has closed, and the tutorial's picture shows it."""
    page = (ROOT / "docs" / "tutorials" / "first-diagram.md").read_text("utf-8")
    words = re.search(r"^magpend (simulate .*)$", page, re.MULTILINE).group(1).split()
    _, notes = command(tmp_path, *words)
    assert "closed: the motion repeats after 2 drive periods" in notes
    kept = ROOT / "docs" / "tutorials" / "first-motion.png"
    assert not tutorials.is_stale(kept, tmp_path / "trajectory.png")


def test_pictures__each_is_made_by_one_page_or_listed():
    """Every picture in the docs is redrawn by one command, `python docs/run_tutorials.py --pictures`."""
    made = [path for page in tutorials.pages().values() for path in tutorials.pictures_of(page)]
    docs = ROOT / "docs"
    kept = {p for suffix in ("png", "webp", "gif") for p in docs.rglob(f"*.{suffix}")}
    listed = {docs / name for name in tutorials.NOT_MADE}
    assert len(made) == len(set(made))
    assert set(made) | listed == kept
    assert not set(made) & listed


def test_follow__commands_before_come_first_and_blocks_for_others_are_left(tmp_path):
    page = tmp_path / "page.md"
    text = "<!-- run: tests -->\n```sh\npip install .\n```\n\n<!-- before: magpend models -->\n"
    page.write_text(text, "utf-8")
    assert tutorials.follow(page, tmp_path) == {}
    page.write_text(text.replace("magpend models", "pip list"), "utf-8")
    with pytest.raises(tutorials.TutorialError, match="only commands of magpend"):
        tutorials.follow(page, tmp_path)


PAGE = """
<!-- file: words.txt -->
```text
one
```

<!-- run -->
```python
print("value 2.0004 at (3, 4)")
```

<!-- printed -->
```text
{line}
```

<!-- picture: {made} -->
![words](words.png)
"""


def follow(tmp_path, line="value 2.0 at (3, 4)", made="words.txt"):
    (tmp_path / "page.md").write_text(PAGE.format(line=line, made=made), "utf-8")
    return tutorials.follow(tmp_path / "page.md", tmp_path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"line": "value 2.1 at (3, 4)"}, "is not printed any more: 'value 2.1"),
        ({"line": "values 2.0 at (3, 4)"}, "is not printed any more"),
        ({"made": "gone.png"}, "no picture"),
    ],
)
def test_follow__a_page_that_does_not_hold(tmp_path, change, said):
    assert follow(tmp_path) == {"words.png": tmp_path / "words.txt"}
    with pytest.raises(tutorials.TutorialError, match=re.escape(said)):
        follow(tmp_path, **change)


def test_index__begins_with_the_example_of_a_followed_page():
    index, page = ((ROOT / "docs" / f"{name}.md").read_text() for name in ("index", "response"))
    first = index.partition("```python\n")[2].partition("```")[0]
    assert first.count("\n") <= 10
    assert f"<!-- run -->\n```python\n{first}```" in page


def test_navigation__every_page_is_in_it():
    """The first page lists all pages, once; the site's navigation is made of its lists."""
    docs = ROOT / "docs"
    listed = re.findall(r"^- \[[^\]]+\]\(([^)]+)\)", (docs / "index.md").read_text("utf-8"), re.MULTILINE)
    pages = {p.relative_to(docs).as_posix() for p in docs.rglob("*.md")} - {"index.md"}
    assert sorted(listed) == sorted(pages)


def test_api__has_every_public_name():
    import magpend

    found = [name for names in program("docs/conf.py").grouped().values() for name in names]
    assert len(found) == len(set(found))
    assert set(found) == {name for name in dir(magpend) if not name.startswith("_")}


def test_build__finds_what_is_loaded_from_elsewhere(tmp_path):
    (tmp_path / "a.html").write_text(
        '<a href="https://a.example">fine</a><script src="https://b.example/x.js"></script>'
        '<link rel="stylesheet" href="//c.example/y.css"><link rel="canonical" href="https://d.example">'
        '<img alt="" src="here.png">',
        "utf-8",
    )
    (tmp_path / "b.css").write_text("@font-face { src: url('https://e.example/f.woff2') }", "utf-8")
    assert program("docs/build.py").loaded_from_elsewhere(tmp_path) == [
        "a.html: https://b.example/x.js",
        "a.html: //c.example/y.css",
        "b.css: https://e.example/f.woff2",
    ]
