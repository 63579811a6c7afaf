"""Machine code on disk: no damage changes a number or stops a run, nobody else's is executed."""

import logging
import os
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from magpend_core.engine import code_cache, jit
from magpend_core.engine.jit import kernel

LONG = os.environ.get("MAGPEND_LONG") == "1"

pytestmark = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="without the compiler there is nothing to keep"
)

EXPOSED = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="this system knows no owners of files")


def cubed(x):
    return x * x * x - 0.1


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """An empty compile cache: its folder."""
    # a command that ran before in this process keeps its lines from other loggers
    monkeypatch.setattr(logging.getLogger("magpend"), "propagate", True)
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path / "cache" / "digest")
    return tmp_path / "cache"


def called(function=cubed, argument=0.3):
    """Value of a function in a fresh dispatcher, and whether its code came from the cache."""
    dispatcher = kernel(function)
    value = dispatcher(argument)
    return value.hex(), bool(sum(dispatcher.stats.cache_hits.values()))


def entries(cache):
    return sorted(cache.rglob("*.nbc"))


def damages(content, rng):
    """Kinds of damage, each with its place drawn."""
    flipped = bytearray(content)
    flipped[rng.integers(len(content))] ^= 1 << rng.integers(8)
    start = int(rng.integers(len(content)))
    zeroed = bytearray(content)
    zeroed[start : start + 512] = bytes(len(content[start : start + 512]))
    return {
        "bit": bytes(flipped),
        "cut": content[:start],
        "empty": b"",
        "zeros": bytes(len(content)),
        "part zeroed": bytes(zeroed) if bytes(zeroed) != content else b"\0",
        "longer": content + b"\0",
        "something else": b"[section]\n",
    }


def test_keep__an_entry_is_read_again(cache):
    first, again = called(), called()
    assert first == (cubed(0.3).hex(), False)
    assert again == (first[0], True)
    assert [path.suffix for path in cache.rglob("*") if path.is_file()] == [".nbc"]


@pytest.mark.slow
@pytest.mark.parametrize("n", [pytest.param(120 if LONG else 28, id="damages")])
def test_keep__damaged_entries_are_compiled_again(cache, caplog, n):
    value = called()[0]
    (path,) = entries(cache)
    content, rng = path.read_bytes(), np.random.default_rng(0)
    for i, kind in zip(range(n), cycle(damages(content, rng))):
        path.write_bytes(damages(content, rng)[kind])
        caplog.clear()
        assert called() == (value, False), (i, kind)
        assert len(caplog.records) <= 1
        # mended: what comes later finds it whole
        assert called() == (value, True), (i, kind)
    assert entries(cache) == [path]


def test_keep__an_entry_of_another_function_is_not_taken(cache):
    def squared(x):
        return x * x

    called()
    (path,) = entries(cache)
    mine = called(squared)
    (other,) = set(entries(cache)) - {path}
    other.write_bytes(path.read_bytes())
    assert called(squared) == (mine[0], False)
    assert called(squared) == (mine[0], True)


@pytest.mark.parametrize("what", ["link to nowhere", "folder", "file above"])
def test_keep__what_cannot_be_an_entry_is_no_failure(cache, what):
    called()
    (path,) = entries(cache)
    path.unlink()
    if what == "link to nowhere":
        path.symlink_to("nowhere")
    elif what == "folder":
        path.mkdir()
    else:
        path.parent.rmdir()
        path.parent.write_text("")
    assert called() == (cubed(0.3).hex(), False)
    assert not [p for p in Path(__file__).parent.rglob("*.nbc") if "cubed" in p.name]


@pytest.fixture
def said(caplog):
    """Take the one record of the log, which has one line."""

    def take():
        (record,) = caplog.records
        assert "\n" not in record.message
        caplog.clear()
        return record.message

    code_cache._made.cache_clear()
    return take


@EXPOSED
@pytest.mark.parametrize("mode", [0o777, 0o775, 0o1777])
@pytest.mark.parametrize("depth", [0, 1, 2])
def test_keep__a_folder_that_others_can_write_to_is_not_used(cache, said, caplog, mode, depth):
    called()
    (path,) = entries(cache)
    exposed = [cache, cache / "digest", path.parent][depth]
    exposed.chmod(mode)
    code_cache._made.cache_clear()
    assert called() == (cubed(0.3).hex(), False)
    message = said()
    for word in (str(exposed), f"owner {os.geteuid()}", f"mode {mode:04o}", f"chmod go-w {exposed}"):
        assert word in message
    assert called() == (cubed(0.3).hex(), False)
    assert not caplog.records  # said once


@EXPOSED
def test_keep__another_users_folder_is_not_used(cache, said, monkeypatch):
    called()
    me = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: me + 1)
    code_cache._made.cache_clear()
    assert called() == (cubed(0.3).hex(), False)
    assert f"belongs to user {me}" in said()


@EXPOSED
def test_keep__an_entry_that_others_could_write_is_not_unpickled(cache):
    called()
    (path,) = entries(cache)
    path.chmod(0o666)
    assert called() == (cubed(0.3).hex(), False)
    assert path.stat().st_mode & 0o777 == 0o600


@EXPOSED
def test_keep__folders_are_made_for_their_owner_alone(cache):
    before = os.umask(0)
    try:
        called()
    finally:
        os.umask(before)
    assert {path.stat().st_mode & 0o077 for path in (cache, *cache.rglob("*"))} == {0}


def test_keep__a_full_disk_costs_the_entry_alone(cache, said, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    assert called() == (cubed(0.3).hex(), False)
    assert "No space left on device" in said()


def test_cache_folder__empty_is_as_unset_and_it_stays_when_the_process_goes_elsewhere(monkeypatch, tmp_path):
    monkeypatch.setenv("MAGPEND_CACHE", "1")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("MAGPEND_CACHE_DIR", "")
    assert jit._cache_folder().parent == tmp_path / "xdg" / "magpend"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MAGPEND_CACHE_DIR", "mine")
    assert jit._cache_folder().parent == tmp_path / "mine"


SCRIPT = """
import sys
from magpend_core.engine import code_cache, jit
def summed(x, y):
    return x + y
dispatcher = jit.kernel(summed)
for word in sys.argv[1]:
    arguments = (1.0, 2.0) if word == "0" else (1, 2)
    print(*(float(dispatcher(*arguments)) for _ in range(3)), sum(dispatcher.stats.cache_hits.values()))
"""


@pytest.mark.slow
def test_keep__two_processes_that_write_at_once(tmp_path):
    """Each signature has a file of its own, so that none is taken for another."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    environment = {**os.environ, "MAGPEND_CACHE_DIR": str(tmp_path / "cache"), "PYTHONWARNINGS": "error"}
    environment["PYTHONPATH"] = str(Path(jit.__file__).parents[2])

    def started(which):
        words = [sys.executable, str(script), which]
        return subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, text=True)

    def printed(process):
        return process.communicate(timeout=120)[0].split()

    assert [printed(process) for process in [started("0"), started("1")]] == [["3.0"] * 3 + ["0"]] * 2
    assert len(entries(tmp_path / "cache")) == 2
    assert printed(started("01")) == ["3.0"] * 3 + ["1"] + ["3.0"] * 3 + ["2"]
    assert len(entries(tmp_path / "cache")) == 2


COMPILES = """
from magpend_core import load_preset, sections
from magpend_core.engine import code_cache, precompiled
made = []
for cache in (code_cache.KeptCode, precompiled.PartCache):
    def save(self, sig, data, kept=cache.save_overload):
        made.append(sig)
        kept(self, sig, data)
    cache.save_overload = save
sections(load_preset("wojna2018"), 0.4, [[0.1, 0.0, 0.0, 0.0]], n_transient=0, n_keep=2)
print(len(made))
"""


@pytest.mark.slow
def test_keep__processes_at_once_compile_each_function_once(tmp_path):
    """One compiles, the others wait and read; whoever is killed holds nobody up."""
    environment = {**os.environ, "MAGPEND_CACHE_DIR": str(tmp_path)}
    environment["PYTHONPATH"] = str(Path(jit.__file__).parents[2])

    def started():
        return subprocess.Popen([sys.executable, "-c", COMPILES], env=environment, stdout=subprocess.PIPE, text=True)

    killed = started()
    while not list(tmp_path.rglob("*.lock")):
        assert killed.poll() is None
        time.sleep(0.01)
    killed.kill()
    killed.communicate()
    before = len([*entries(tmp_path), *tmp_path.rglob("*.part")])
    counts = [int(process.communicate(timeout=300)[0]) for process in [started() for _ in range(3)]]
    assert sum(counts) + before == len([*entries(tmp_path), *tmp_path.rglob("*.part")])
    assert max(counts) > 20
    assert not list(tmp_path.rglob("*.lock"))


def test_keep__threads_at_once_find_their_folder(cache, monkeypatch, tmp_path):
    """Whoever computes in threads binds kernels there: each has its place in the cache, none elsewhere."""
    monkeypatch.chdir(tmp_path)
    waits, begin = cycle([0.0, 0.004, 0.001]), code_cache.FunctionCache.__init__

    def after_a_while(self, function):
        time.sleep(next(waits))
        begin(self, function)

    monkeypatch.setattr(code_cache.FunctionCache, "__init__", after_a_while)
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: kernel(cubed), range(32)))
    assert {Path(one._cache.cache_path).is_relative_to(cache) for one in made} == {True}
    assert [path.name for path in tmp_path.iterdir()] == [cache.name]


def test_keep__no_warning_reaches_people_who_turn_them_into_errors(cache):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        called()
        entries(cache)[0].write_bytes(b"")
        called()
