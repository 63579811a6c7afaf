"""Docs' "your own system in ten minutes", as a new user would: what is typed there is done here."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from magpend_core.models.text.grammar import FUNCTIONS
from magpend_core.models.text.reading import KEYS
from pipeline.specification.spec import Spec

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "own-system.md").read_text("utf-8")


def block(mark: str, language: str) -> str:
    (text,) = re.findall(rf"<!-- {mark} -->\n```{language}\n(.*?)```", PAGE, re.DOTALL)
    return text


@pytest.mark.slow
def test_own_system__every_command_of_the_page(main, tmp_path):
    (tmp_path / "mine.toml").write_text(block("file: mine.toml", "toml"), "utf-8")
    done = []
    for line in block("run", "sh").splitlines():
        words = shlex.split(line, comments=True)[1:]
        small = [*words, "--smoke", "--out", "runs/mine", "--workers", "0"] if words[0] == "run" else words
        code, out, said = main(*small)
        assert code == 0, (words, said)
        done.append(words[0])
        if words[0] == "model":
            assert "dv/dt = drive - d*v - x**3" in out
            assert "checks: passed" in out
        if words[:2] == ["analyse", "basins"]:
            assert "an attractor that no cell shows" in out
    assert done == ["model", "simulate", "run", "analyse", "plot"]
    assert (tmp_path / "trajectory.png").is_file()
    assert (tmp_path / "runs" / "mine" / "figures" / "basins.png").is_file()


def test_own_system__text_of_the_page_is_twenty_lines_and_errors_are_as_it_says(main, tmp_path):
    text = block("file: mine.toml", "toml")
    lines = [line for line in text.splitlines() if line.strip()]
    assert len(lines) <= 25
    wrong = text.replace("drive - d*v", "driv - d*v").replace("rtol = 1e-7", "rtol = -1")
    wrong = wrong.replace("\natol", "\n#")
    (tmp_path / "mine.toml").write_text(wrong, "utf-8")
    said = main("run", "mine.toml")[2]
    for line in said.splitlines():
        assert line in PAGE
    (tmp_path / "mine.toml").write_text(text.replace("- x**3", "- log(x + 0.5)"), "utf-8")
    said = main("run", "mine.toml", "--smoke")[2]
    assert said[:100] in PAGE


def test_own_system__page_names_every_key_and_function():
    for key in KEYS:
        assert f"`{key}`" in PAGE, key
    (functions,) = re.findall(r"^    (sin .*)$", PAGE, re.MULTILINE)
    assert set(functions.split()) == set(FUNCTIONS)


def test_own_system__section_without_a_drive_fits():
    (section,) = re.findall(r"```toml\n(\[section\].*?)```", PAGE, re.DOTALL)
    data = tomllib.loads(block("file: mine.toml", "toml") + "\n" + section)
    data["model"]["equations"]["v"] = "(1 - x**2)*v - x"
    del data["parameters"], data["model"]["define"], data["smoke"]
    assert Spec.parse(data).section is not None
