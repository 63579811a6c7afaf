"""Messages point to sections of the page of troubleshooting, which exist; versions are those of this machine."""

from __future__ import annotations

import ast
import pickle
import re
import sys
from importlib import metadata

import pytest

import magpend
from magpend_core.engine.jit import CACHE_FOLDER
from magpend_core.status import Status
from magpend_core.troubleshooting import PAGE, see
from pipeline.cli import main as command_line
from pipeline.specification.section import SectionTable
from pipeline.specification.tables import Execution, Integration
from pipeline.store import errors
from tests.programs import ROOT

TEXT = (ROOT / PAGE).read_text("utf-8")


def anchors(text):
    """Anchors of headings, as GitHub and the site make them."""
    heads = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return [re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads]


def topics():
    """Every topic that the code names, with the file."""
    for folder in ("magpend_core", "pipeline"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            source = path.read_text("utf-8")
            for node in ast.walk(ast.parse(source)) if "see(" in source else ():
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "see":
                    (topic,) = node.args
                    if isinstance(topic, ast.Constant):
                        yield path.relative_to(ROOT).as_posix(), topic.value
    for status in Status:
        for topic in re.findall(r"#([\w-]+)", status.advice):
            yield f"status {status.name.lower()}", topic
    for name, kind in vars(errors).items():
        if getattr(kind, "topic", ""):
            yield name, kind.topic


@pytest.mark.parametrize(("where", "topic"), sorted(set(topics())))
def test_see__the_page_has_the_section(where, topic):
    assert topic in anchors(TEXT)


def test_page__every_section_is_in_the_table_of_messages_and_says_what_to_do():
    listed = re.findall(r"\]\(#([\w-]+)\)", TEXT)
    sections = re.split(r"^###? ", TEXT, flags=re.MULTILINE)[1:]
    groups = {"Cells", "Attractors", "Branches and curves", "The machine"}
    found = {text.partition("\n")[0]: text for text in sections if text.partition("\n")[0] not in groups}
    assert sorted(listed) == sorted(anchors("\n".join(f"# {head}" for head in found)))
    for head, text in found.items():
        assert head == "Report it" or ("**Meaning.**" in text and ("**Do**" in text or "what to do" in text)), head


def test_page__keys_and_links_exist():
    tables = {"integration": Integration, "section": SectionTable, "execution": Execution}
    for table, key in re.findall(r"`\[?(integration|section|execution)\]?[. ](\w+)", TEXT):
        assert key in tables[table].model_fields, key
    for page, anchor in re.findall(r"\]\(([\w-]+\.md)#([\w-]+)\)", TEXT):
        assert anchor in anchors((ROOT / "docs" / page).read_text("utf-8")), (page, anchor)


def test_status__failures_point_to_their_section_and_known_orbits_to_none():
    assert Status.STEP_LIMIT.advice == f"{Status.STEP_LIMIT.sentence} (see {PAGE}#step-limit)"
    assert Status.PERIODIC.advice == Status.PERIODIC.sentence
    assert all("#" not in status.sentence for status in Status)  # stored in cubes


def test_store_error__its_note_names_the_section_once_also_from_another_process(capsys):
    error = pickle.loads(pickle.dumps(errors.DamagedError("a file")))
    assert str(error) == "a file"
    assert error.__notes__ == [see("damaged")]
    command_line._complain(error)
    assert capsys.readouterr().err == f"magpend: a file {see('damaged')}\n"
    command_line._complain(errors.RefusedError("a folder"))
    assert capsys.readouterr().err == "magpend: a folder\n"


def test_show_versions__names_what_a_report_needs(capsys):
    magpend.show_versions()
    text = capsys.readouterr().out
    rows = dict(line.split(None, 1) for line in text.splitlines() if " " in line.strip() and not line.startswith(" "))
    assert rows["magpend"].startswith(metadata.version("magpend"))
    assert rows["python"].startswith(".".join(map(str, sys.version_info[:3])))
    assert re.search(r"with [\w, .]+; \d+ cores", rows["cpu"])
    assert str(CACHE_FOLDER or "not kept") in text
    required, _, optional = text.partition("optional packages")
    assert re.search(rf"^  numpy +{re.escape(metadata.version('numpy'))}$", required, re.MULTILINE)
    assert re.search(r"^  emcee \(mcmc\) +\S+", optional, re.MULTILINE)


def test_versions__option_prints_the_same(command, tmp_path, capsys):
    out, _ = command(tmp_path, "--versions")
    magpend.show_versions()
    assert out == capsys.readouterr().out
