"""The directory of an identification: refused, resumed, complete."""

from __future__ import annotations

import json
import tomllib

import pytest

from pipeline.rig.identify import directory as d
from pipeline.rig.identify.specification import parse_identification
from pipeline.store.errors import DamagedError, RefusedError

from .test_specification import GOOD


@pytest.fixture
def spec(tmp_path):
    (tmp_path / "a.csv").write_text("1,2")
    (tmp_path / "a.toml").write_text("model = 'duffing'")
    return lambda text=GOOD: parse_identification(tomllib.loads(text), tmp_path)


@pytest.fixture
def begun(tmp_path, spec):
    one = spec()
    return d.establish(tmp_path / "out", one, d.sources_of(one), GOOD)


def test_establish__twice_is_the_same(tmp_path, spec, begun):
    before = (begun.directory / d.IDENTIFICATION).read_bytes()
    one = spec()
    assert d.establish(begun.directory, one, d.sources_of(one), GOOD) == begun
    assert (begun.directory / d.IDENTIFICATION).read_bytes() == before


def test_check__values_and_recordings_count_and_a_title_does_not(tmp_path, spec, begun):
    def checked(text=GOOD, folder=begun.directory):
        one = spec(text)
        return d.check(folder, d.identity_of(one, d.sources_of(one)))

    assert checked(GOOD.replace("a ring-down", "another title")) == begun
    with pytest.raises(RefusedError, match=r"identify\.damping\.start: 0\.2 in the directory, 0\.25 now"):
        checked(GOOD.replace("0.2", "0.25"))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    with pytest.raises(RefusedError, match="holds no identification"):
        checked(folder=tmp_path / "run")
    (tmp_path / "a.csv").write_text("1,3")
    with pytest.raises(RefusedError, match="recordings"):
        checked()


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
