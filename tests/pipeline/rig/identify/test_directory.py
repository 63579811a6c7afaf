"""The directory of an identification: refused, resumed, complete."""

from __future__ import annotations

import json
import tomllib

import pytest

from pipeline.rig.identify import directory as d
from pipeline.rig.identify.specification import parse_identification
from pipeline.store.errors import DamagedError, RefusedError

TEXT = """
kind = "identification"
title = "a ring-down"
model = "duffing"
preset = "hardening"
[identify.damping]
start = 0.2
[[recordings]]
file = "a.csv"
mapping = "a.toml"
"""


@pytest.fixture
def spec(tmp_path):
    (tmp_path / "a.csv").write_text("1,2")
    (tmp_path / "a.toml").write_text("model = 'duffing'")
    return lambda text=TEXT: parse_identification(tomllib.loads(text), tmp_path)


@pytest.fixture
def begun(tmp_path, spec):
    one = spec()
    return d.establish(tmp_path / "out", one, d.sources_of(one), TEXT)


def test_establish__twice_is_the_same(tmp_path, spec, begun):
    before = (begun.directory / d.IDENTIFICATION).read_bytes()
    one = spec()
    assert d.establish(begun.directory, one, d.sources_of(one), TEXT) == begun
    assert (begun.directory / d.IDENTIFICATION).read_bytes() == before


def test_check__a_title_does_not_count(spec, begun):
    other = spec(TEXT.replace("a ring-down", "another title"))
    assert d.check(begun.directory, d.identity_of(other, d.sources_of(other))) == begun


def test_check__names_what_differs(spec, begun):
    other = spec(TEXT.replace("0.2", "0.25"))
    with pytest.raises(RefusedError, match=r"identify\.damping\.start: 0\.2 in the directory, 0\.25 now"):
        d.check(begun.directory, d.identity_of(other, d.sources_of(other)))


def test_check__other_recordings_differ(tmp_path, spec, begun):
    (tmp_path / "a.csv").write_text("1,3")
    with pytest.raises(RefusedError, match="recordings"):
        d.check(begun.directory, d.identity_of(spec(), d.sources_of(spec())))


def test_check__refuses_a_folder_that_holds_something_else(tmp_path, spec):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    with pytest.raises(RefusedError, match="holds no identification"):
        d.check(tmp_path / "run", d.identity_of(spec(), d.sources_of(spec())))


def test_read_info__damaged(begun):
    path = begun.directory / d.IDENTIFICATION
    data = json.loads(path.read_text())
    data["identity"]["spec"]["model"] = "other"
    path.write_text(json.dumps(data))
    with pytest.raises(DamagedError, match="digest does not fit"):
        d.read_info(begun.directory)


def test_is_complete__looks_at_every_file(begun):
    folder = begun.directory
    assert not d.is_complete(folder)
    (folder / d.PRESET).write_text("[x]")
    d.write_result(folder, {"estimates": {}}, [d.PRESET])
    assert d.is_complete(folder)
    (folder / d.PRESET).write_text("[y]")
    assert not d.is_complete(folder)
