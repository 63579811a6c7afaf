"""What README and docs show is what magpend takes, and their tables are those of the code."""

from __future__ import annotations

import pkgutil
import re
import shlex
import sys
import tomllib

import pytest
from typer.main import get_command

from pipeline.cli import main, reference
from pipeline.cli.console import Exit
from pipeline.cli.main import app
from pipeline.layout.vocabulary import FREQUENCY_DIM
from pipeline.specification.files import shipped_workflows
from tests.programs import ROOT

LATER = {"clients.py", "jobqueue.py"}
README = (ROOT / "README.md").read_text("utf-8")
PAGES = {page.relative_to(ROOT).as_posix(): page.read_text("utf-8") for page in reference.pages()}
PAGES["CONTRIBUTING.md"] = (ROOT / "CONTRIBUTING.md").read_text("utf-8")


def blocks(language, text=README):
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


@pytest.mark.slow
def test_readme__example_finds_five_attractors(tmp_path, monkeypatch, capsys):
    (block,) = blocks("python")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(block, names)
    assert capsys.readouterr().out.count("attracts") == 5
    assert (tmp_path / "basins.png").is_file()


def test_readme__fits_one_screen_and_leads_to_a_system_of_ones_own():
    assert len(README.splitlines()) <= 65
    assert "](docs/quickstart.png)" in README
    links = re.findall(r"(?<!!)\[[^\]]+\]\(([^)]+)\)", README)
    assert links[:2] == ["docs/python-start.md", "docs/own-system.md"]


def test_install__names_extras_of_a_checkout_and_no_distribution_of_an_index():
    """Messages of `clients.py` and `jobqueue.py` are written anew elsewhere."""
    known = set(tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"])
    modules = [path for path in (ROOT / "pipeline").rglob("*.py") if path.name not in LATER]
    for text in (*PAGES.values(), *(path.read_text("utf-8") for path in modules)):
        assert not re.search(r"pip install (-\S+ )*['\"]?magpend", text)
    named = {
        name
        for text in PAGES.values()
        for names in re.findall(r"pip install '\.\[([^\]]*)\]'", text)
        for name in names.split(",")
    }
    assert named
    assert named <= known


@pytest.mark.parametrize("page", PAGES)
def test_docs__links_lead_somewhere(page):
    folder = (ROOT / page).parent
    for target in re.findall(r"\]\(([^)#]+)\)", PAGES[page]):
        if not target.startswith("http"):
            assert (folder / target).exists(), target


def commands():
    """Every line of a shell block that begins with magpend, with its page; not those of an analysis of users."""
    for page, text in PAGES.items():
        if page == "docs/own-analysis.md":
            continue
        for block in blocks("sh", text):
            for line in re.sub(r"\\\n\s*", " ", block).splitlines():
                for part in line.split("&&"):
                    words = shlex.split(part, comments=True)
                    if words and words[0] == "magpend":
                        yield page, words[1:]


@pytest.mark.slow
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


@pytest.mark.slow
def test_reference__has_every_option_of_every_command():
    """It stands with the command, with one whose options the command takes, or among those of several commands."""
    lines = [line.replace("\\|", "/") for line in PAGES["docs/reference/commands.md"].splitlines()]
    rows = [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines if line.startswith("| `")]
    found = dict(reference._commands())

    def told(name):
        of_base = set()
        for row in rows:
            if len(row) == 2 and re.match(rf"`magpend {name}[ `]", row[0]):
                of_base = {
                    flag
                    for other in re.findall(r"Takes the options of (.*)\.", row[1])
                    for base in re.findall(r"`([^`]+)`", other)
                    for flag in told(base)
                }
        own = {row[1] for row in rows if len(row) == 3 and row[0] == f"`{name}`"}
        shared = {row[0] for row in rows if len(row) == 3 and row[0].startswith("`-") and takes(row[1], name)}
        return own | shared | of_base

    def takes(words, name):
        group = name.partition(" ")[0]
        (but,) = re.findall(rf"all of `{group}`(?: but ((?:`{group} [\w-]+`(?:, )?)+))?", words) or [None]
        return f"`{name}`" in words if but is None else f"`{name}`" not in but

    for name, command in found.items():
        assert {flag.replace("|", "/") for flag, _ in reference._options(command)} <= told(name), name


@pytest.mark.parametrize("name", ["main job", "tests", "slow tests"])
def test_readme__commands_for_ci_are_one_line(name):
    (command,) = re.findall(rf"<!-- run: {name} -->\n```sh\n(.*?)\n```", README, re.DOTALL)
    assert "\n" not in command


# the page for programs

AGENTS = (ROOT / "AGENTS.md").read_text("utf-8")


def test_agents__lists_all_exit_codes():
    rows = re.findall(r"^\| ([\d, ]+) \| ([^|]+) \|", AGENTS, re.M)
    said = {int(code): meaning for codes, meaning in rows for code in codes.split(",")}
    assert set(said) == {int(code) for code in Exit}
    for code in Exit:
        if code < Exit.HUNG_UP:
            assert said[code] == code.sentence
        else:
            assert code.sentence.endswith(said[code].partition("; ")[2])


def test_agents__shows_the_error_that_comes(tmp_path, monkeypatch, capsys):
    ((edit, shown),) = re.findall(r"<!-- error: sed '([^']+)' -->\n```text\n(.*?)```", AGENTS, re.DOTALL)
    (text,) = re.findall(r"<!-- file: sweep.toml -->\n```toml\n(.*?)```", AGENTS, re.DOTALL)
    for old, new in re.findall(r"s/([^/]+)/([^/]+)/", edit):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "sweep.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["magpend", "run", "sweep.toml"])
    with pytest.raises(SystemExit) as end:
        main.main()
    said = capsys.readouterr()
    assert end.value.code == Exit.REFUSED
    assert said.err.endswith(shown)
    assert said.out == ""
    assert not (tmp_path / "runs").exists()


# the article


def test_paper__cites_what_its_bibliography_has():
    text = (ROOT / "paper" / "paper.md").read_text("utf-8")
    listed = (ROOT / "paper" / "paper.bib").read_text("utf-8")
    entries = dict(re.findall(r"^@\w+\{(\w+),\n(.*?)^\}", listed, re.MULTILINE | re.DOTALL))
    cited = set(re.findall(r"@([a-z]+\d{4})\b", text))
    assert cited == set(entries)
    for name, entry in entries.items():
        assert re.search(r"^  (doi|url|isbn) +=", entry, re.MULTILINE), name
        assert re.search(rf"year += \{{{name[-4:]}\}}", entry), name
    body = text.partition("\n---\n")[2].partition("# References")[0]
    assert 750 < len(body.split()) < 1750  # what the journal asks for


def test_paper__figures_are_those_of_the_docs():
    text = (ROOT / "paper" / "paper.md").read_text("utf-8")
    figures = re.findall(r"\]\(\.\./(docs/[\w/-]+\.png)\)", text)
    assert len(figures) == text.count("\\label{fig:")
    assert all((ROOT / name).is_file() for name in figures)
