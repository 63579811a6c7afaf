"""Run directories from strangers: nothing of them is executed, followed out or blown up."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numcodecs.blosc
import numpy as np
import pytest

from pipeline.runs.derive import derive
from pipeline.store import products
from pipeline.store.commits import read_commits
from pipeline.store.declared import Declared
from pipeline.store.errors import DamagedError
from pipeline.store.objects import open_files
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import read_run
from tests.pipeline.store.conftest import QUICK

ROOT = Path(__file__).parents[3]


def plan_of(directory):
    return read_run(directory).plan


def bomb(n_bytes):
    """A chunk of a few bytes that declares many, in the codecs of the cube."""
    content = bytearray(numcodecs.blosc.compress(np.zeros(1000), b"lz4", 5, 1))
    content[4:8] = n_bytes.to_bytes(4, "little")
    return bytes(content) + bytes(4)


# ---- what files declare ------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["section/c.0.0.0.0.0", "status/c.0.0.0", "x_0/c.0", "state/c.0"])
def test_declared__bombs_and_cut_chunks_are_refused_by_what_they_declare(place, key):
    declared = Declared(plan_of(place))
    for n_bytes in (2**31 - 17, 2**32 - 1, 16_000_000):
        content = bytes(4) + n_bytes.to_bytes(4, "little") + bytes(16)
        assert str(n_bytes) in declared.problem(key, content)
    for content in (b"", b"\x02\x01\x21"):
        assert declared.problem(key, content) is not None


def test_declared__texts_are_as_many_as_there_is_room_for(place):
    declared = Declared(plan_of(place))
    cube = place / "cube.zarr" / "state"
    assert declared.problem("state/zarr.json", (cube / "zarr.json").read_bytes()) is None
    content = bytearray(numcodecs.blosc.decompress((cube / "c.0").read_bytes()[:-4]))
    assert int.from_bytes(content[:4], "little") == 2
    content[:4] = (2**31).to_bytes(4, "little")
    packed = numcodecs.blosc.compress(bytes(content), b"lz4", 5, 1) + bytes(4)
    problem = declared.problem("state/c.0", packed)
    assert problem == f"declares {2**31} texts, and may have 8"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"shape": [3, 3, 3, 8, 2**40]}, "another shape"),
        ({"data_type": "complex128"}, "another shape"),
        ({"codecs": [{"name": "bytes"}, {"name": "gzip"}, {"name": "crc32c"}]}, "gzip"),
        ({"codecs": [{"name": "numcodecs.pickle"}]}, "numcodecs.pickle"),
        ({"codecs": 3}, "no metadata"),
        ({"chunk_grid": {"configuration": {"chunk_shape": [2**40] * 5}}}, "another shape"),
    ],
)
def test_declared__metadata_of_other_shapes_and_codecs(place, change, words):
    declared = Declared(plan_of(place))
    data = json.loads((place / "cube.zarr" / "section" / "zarr.json").read_bytes())
    assert words in declared.problem("section/zarr.json", json.dumps({**data, **change}).encode())
    assert declared.problem("section/zarr.json", b"[" * 100_000) == "is no metadata of an array"


def committed(directory, key, content):
    """Put a chunk in place with a record that vouches for it, as who made the directory could."""
    opened = RunDirectory.open(directory)
    commits = dict(read_commits(opened.info))
    for commit in commits.values():
        if key in commit.objects:
            objects = dict(commit.objects)
            objects[key] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            object.__setattr__(commit, "objects", objects)
    (directory / "cube.zarr" / key).write_bytes(content)
    return RunDirectory(opened.info, commits)


@pytest.mark.parametrize("key", ["section/c.0.0.0.0.0", "n_steps/c.0.0.0"])
@pytest.mark.parametrize("check", [True, False])
def test_cube__bombs_are_not_decompressed(place, key, check, monkeypatch):
    opened = committed(place, key, bomb(2**31 - 17))

    def decompress(*arguments, **options):
        raise AssertionError("it was decompressed")

    name = key.partition("/")[0]
    cube = opened.cube(check=check).reset_coords(drop=True)
    monkeypatch.setattr(numcodecs.blosc, "decompress", decompress)
    monkeypatch.setattr(numcodecs.blosc.Blosc, "decode", decompress, raising=False)
    with pytest.raises(DamagedError, match="declares 2147483631 bytes, and has"):
        cube[name].load()


@pytest.mark.slow
def test_open_product__bombs_are_computed_again(place):
    product = next((place / "derived").glob("attractors-*.zarr"))
    chunk = next(f for f in sorted(product.rglob("c*")) if f.is_file())
    chunk.write_bytes(bomb(2**31 - 17))
    path = product / "zarr.json"
    data = json.loads(path.read_text())
    attrs = {k: v for k, v in data["attributes"].items() if k != products.SEAL}
    seal = products._seal(attrs, products._digests(open_files(product)))
    data["attributes"] = {**attrs, products.SEAL: seal}
    path.write_text(json.dumps(data))
    with pytest.raises(DamagedError, match="declares 2147483631 bytes"):
        products.open_product(product)
    said = []
    derive(place, "attractors", QUICK, echo=said.append)
    assert "computing it again" in said[0]


# ---- nothing is executed -------------------------------------------------------------------------------

WATCHED = """
import sys
place = {place!r}
seen = []

def watch(event, arguments):
    if event in ("pickle.find_class", "os.system", "subprocess.Popen", "os.exec", "os.posix_spawn"):
        seen.append((event, str(arguments)[:200]))
    elif event == "import" and place in str(arguments[1:3]):
        seen.append((event, str(arguments)[:200]))
    elif event in ("compile", "exec") and (place in str(arguments) or "BOOM" in str(arguments)):
        seen.append((event, str(arguments)[:200]))
    elif event == "open" and "/etc/passwd" in str(arguments[0]):
        seen.append((event, str(arguments)[:200]))

import numpy, xarray, zarr, matplotlib.pyplot, numba, dask.array, dask.delayed, distributed
from pipeline.cli.main import main
from pipeline.products import registry
import pipeline.runs.run, pipeline.runs.status, pipeline.runs.verify, pipeline.runs.derive
import pipeline.cli.running
import pipeline.plots, pipeline.store.reading, pipeline.plots.bifurcation, pipeline.runs.drawing, platform
platform.uname()
sys.addaudithook(watch)
for words in {commands!r}:
    sys.argv = ["magpend", *words]
    try:
        main()
    except SystemExit as end:
        print("exit", words[0], end.code, file=sys.stderr)
    except BaseException as error:
        print("raised", words[0], repr(error), file=sys.stderr)
print("SEEN", seen)
"""


@pytest.mark.slow
def test_commands__execute_nothing_of_a_run_directory(place, tmp_path):
    """Opening, verifying, analysing and drawing: no import, no pickle, no process, no file outside."""
    for name in ("sitecustomize.py", "numpy.py", "__init__.py", "conftest.py", "duffing.py", "BOOM.py"):
        (place / name).write_text("raise SystemExit('BOOM')")
    (place / "derived" / "evil.pkl").write_bytes(b"cos\nsystem\n(S'touch BOOM'\ntR.")
    (place / "cube.zarr" / "evil").symlink_to("/etc/passwd")
    (place / "commits" / "passwd.json").symlink_to("/etc/passwd")
    # the compiled code of the analyses comes from the cache, whose pickles are the user's own
    run = str(place)
    commands = [["status", run], ["verify", run], ["plot", "bifurcation", run], ["status", run, "--json"]]
    script = tmp_path / "watched.py"
    script.write_text(WATCHED.format(place=run, commands=commands))
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'pipeline' / 'face'}", "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, script], cwd=place, env=environment, capture_output=True, text=True, timeout=250, check=False
    )
    assert "SEEN []" in done.stdout, done.stdout + done.stderr
    assert "raised" not in done.stderr
    assert not (place / "BOOM").exists()
    assert (place / "figures").is_dir()


# ---- folders that cannot be written to -----------------------------------------------------------------


def test_derive__says_before_computing_that_nothing_is_kept(place):
    """A file in the place of the folder: not even root writes there."""
    shutil.rmtree(place / "derived")
    (place / "derived").write_text("")
    said = []
    found = derive(place, "attractors", QUICK, echo=said.append)
    assert "is no folder: the result of attractors is shown but not kept" in said[0]
    assert "attractors: computed" in said[-2]
    assert "not kept" in said[-1]
    assert found.sizes


def test_plot__a_figure_that_cannot_be_written_is_refused_before_it_is_drawn(place, monkeypatch, main):
    from pipeline.runs import drawing

    (place / "figures").write_text("")

    def drawn(*arguments):
        raise AssertionError("it was drawn")

    monkeypatch.setattr(drawing, "drawn", drawn)
    code, _, said = main("plot", "bifurcation", place)
    assert code == 2
    assert "figures: is no folder; give another place for the figure: --out FILE." in said
