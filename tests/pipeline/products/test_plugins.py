"""Plug-ins: what they list is there, and another one's input, picture and measure serve a study."""

import sys
from dataclasses import fields
from pathlib import Path
from types import ModuleType

import pytest

from pipeline.products import plugins
from pipeline.products.plugins import Plugin, added
from pipeline.report.estimates import Estimate
from pipeline.report.pictures import Picture, kinds
from pipeline.report.study import load_study
from pipeline.specification.problems import SpecError

STUDY = """
title = "one"
source = "nobody"
[recordings.r]
rig = "rig.toml"
[[figures]]
number = "1"
title = "a"
[[figures.pictures]]
kind = "sketch"
of = "r"
caption = "A sketch."
[[figures.claims]]
statement = "There is one."
source = "nobody"
measure = "recorded_duty_cycle"
of = ["r"]
least = 0.5
"""


def test_added__all_that_is_listed_is_there():
    for one in fields(Plugin):
        assert added(one.name), one.name


def test_added__another_plug_in(monkeypatch, tmp_path):
    file = tmp_path / "study.toml"
    file.write_text(STUDY, "utf-8")
    with pytest.raises(SpecError, match=r"pictures\[0\]\.kind: unknown kind of picture 'sketch'"):
        load_study(file)
    module = ModuleType("a_plugin")
    module.SKETCH = Picture("a sketch", lambda results, table: None)
    module.one = lambda results, of, options: Estimate(1.0, 1.0, 1.0)
    module.PLUGIN = Plugin(pictures={"sketch": "a_plugin:SKETCH"}, measures={"one": "a_plugin:one"})
    monkeypatch.setitem(sys.modules, "a_plugin", module)
    monkeypatch.setattr(plugins, "PLUGINS", (*plugins.PLUGINS, "a_plugin"))
    assert kinds()["sketch"].meaning == "a sketch"
    assert added("measures")["one"](None, [], {}).value == 1.0
    assert load_study(file).path == Path(file)
