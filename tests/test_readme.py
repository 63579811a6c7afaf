"""What README shows is what magpend takes."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from typer.main import get_command

from magpend_core.models import load_model
from pipeline.cli.main import app
from pipeline.layout.schema import base_variables
from pipeline.runs.workflows import shipped_workflows
from pipeline.spec.parsing import parse_spec

VARIABLES = base_variables(load_model())

README = (Path(__file__).parents[1] / "README.md").read_text("utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_readme__specification_is_valid():
    (text,) = blocks("toml")
    data = tomllib.loads(text)
    smoke = data.pop("smoke")
    assert parse_spec(data).kind == "continuation"
    assert smoke["axes"]["frequency_hz"] == {"num": 5}


def test_readme__commands_exist():
    known = get_command(app).commands
    named = set(re.findall(r"`magpend (\w+)", README)) - {"COMMAND"}
    assert named <= set(known)
    assert set(known) <= named


def test_readme__workflows_and_variables_are_listed():
    for name in shipped_workflows():
        assert f"`{name}`" in README
    for variable in VARIABLES:
        assert f"`{variable.name}`" in README


@pytest.mark.parametrize("name", ["main job", "tests"])
def test_readme__commands_for_ci_are_one_line(name):
    (command,) = re.findall(rf"<!-- run: {name} -->\n```sh\n(.*?)\n```", README, re.DOTALL)
    assert "\n" not in command
