"""What README and docs show is what magpend takes, and their tables are those of the code."""

from __future__ import annotations

import pkgutil
import re
import shlex
import tomllib
from pathlib import Path

import pytest
from typer.main import get_command

from pipeline.cli import reference
from pipeline.cli.main import app
from pipeline.layout.vocabulary import FREQUENCY_DIM
from pipeline.runs.workflows import shipped_workflows
from pipeline.specification.parsing import parse_spec

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text("utf-8")
PAGES = {page.relative_to(ROOT).as_posix(): page.read_text("utf-8") for page in reference.pages()}
PAGES["CONTRIBUTING.md"] = (ROOT / "CONTRIBUTING.md").read_text("utf-8")


def blocks(language, text=README):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def test_readme__specification_is_valid():
    (text,) = blocks("toml")
    data = tomllib.loads(text)
    smoke = data.pop("smoke")
    assert parse_spec(data).kind == "continuation"
    assert smoke["axes"]["frequency_hz"] == {"num": 5}


def test_readme__fits_two_screens():
    assert len(README.splitlines()) <= 130
    assert "](docs/quickstart.png)" in README


@pytest.mark.parametrize("page", PAGES)
def test_docs__tables_are_those_of_the_code(page):
    """Mended by: python -m pipeline.cli.reference."""
    assert reference.rendered(PAGES[page]) == PAGES[page]


@pytest.mark.parametrize("page", PAGES)
def test_docs__links_lead_somewhere(page):
    folder = (ROOT / page).parent
    for target in re.findall(r"\]\(([^)#]+)\)", PAGES[page]):
        if not target.startswith("http"):
            assert (folder / target).exists(), target


def commands():
    """Every line of a shell block that begins with magpend, with its page."""
    for page, text in PAGES.items():
        for block in blocks("sh", text):
            for line in re.sub(r"\\\n\s*", " ", block).splitlines():
                for part in line.split("&&"):
                    words = shlex.split(part, comments=True)
                    if words and words[0] == "magpend":
                        yield page, words[1:]


@pytest.mark.parametrize(("page", "words"), list(commands()), ids=lambda value: str(value))
def test_docs__commands_and_options_exist(page, words):
    command = get_command(app)
    while hasattr(command, "list_commands"):
        name = words.pop(0)
        if name not in command.list_commands(None) and hasattr(command, "default"):
            name = command.default
        assert name in command.list_commands(None), (page, name)
        command = command.get_command(None, name)
    flags = {flag for p in command.params for flag in (*p.opts, *p.secondary_opts)}
    takes_names = command.context_settings.get("ignore_unknown_options", False)
    for word in words:
        if word.startswith("--"):
            assert takes_names or word.partition("=")[0] in flags, (page, word)


@pytest.mark.parametrize("page", PAGES)
def test_docs__names_in_python_exist(page):
    import magpend

    for block in blocks("python", PAGES[page]):
        compile(block, page, "exec")
        for name in re.findall(r"(?<![\w.])magpend\.(\w+)", block):  # not the accessor of a Dataset
            assert hasattr(magpend, name), (page, name)


@pytest.mark.parametrize("page", PAGES)
def test_docs__modules_and_files_exist(page):
    for name in re.findall(r"`((?:pipeline|magpend_core)(?:\.\w+)+)`", PAGES[page]):
        pkgutil.resolve_name(name)
    for name in re.findall(r"`?((?:pipeline|magpend_core|tests|workflows)/[\w/.-]+)", PAGES[page]):
        assert "NAME" in name or (ROOT / name.rstrip(".")).exists(), name


def test_reference__names_everything():
    """Commands, workflows and variables are listed with their names."""
    listed = PAGES["docs/reference/commands.md"]
    for name in shipped_workflows():
        assert f"`{name}`" in listed
    assert "`magpend analyse branches DIR`" in listed
    assert "`section`" in PAGES["docs/reference/cube.md"]
    assert f"`{FREQUENCY_DIM}`" in PAGES["docs/reference/cube.md"]


@pytest.mark.parametrize("name", ["main job", "tests"])
def test_readme__commands_for_ci_are_one_line(name):
    (command,) = re.findall(rf"<!-- run: {name} -->\n```sh\n(.*?)\n```", README, re.DOTALL)
    assert "\n" not in command
