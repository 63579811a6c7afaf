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

from pipeline.layout.plan import make_plan
from pipeline.runs.derive import derive
from pipeline.specification.models import KEPT
from pipeline.specification.spec import Spec
from pipeline.store import products
from pipeline.store.arrays import Declared, declared_bytes
from pipeline.store.commits import read_commits
from pipeline.store.errors import DamagedError
from pipeline.store.objects import open_files
from pipeline.store.run import RunDirectory
from pipeline.store.runfile import read_run
from pipeline.store.stored_json import seal, unseal
from tests.pipeline.factories import SQUARE, duffing, finished

ROOT = Path(__file__).parents[3]
SPEC = duffing(
    "amplitude = { start = 0.2, stop = 0.3, num = 3 }",
    SQUARE,
    n_transient=30,
    n_keep=8,
    more="[parameters]\nfrequency_hz = 0.2",
)
QUICK = {"polish": False, "extend": False}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A finished run with a derived product."""
    directory = finished(tmp_path_factory.mktemp("sound"), SPEC)
    derive(directory, "attractors", QUICK)
    return directory


@pytest.fixture
def hostile(sound, tmp_path):
    """A copy of the run to be changed."""
    return Path(shutil.copytree(sound, tmp_path / "run"))


def plan_of(directory):
    return make_plan(Spec.parse(read_run(directory).spec, KEPT))


def bomb(n_bytes):
    """A chunk of a few bytes that declares many, in the codecs of the cube."""
    content = bytearray(numcodecs.blosc.compress(np.zeros(1000), b"lz4", 5, 1))
    content[4:8] = n_bytes.to_bytes(4, "little")
    return bytes(content) + bytes(4)


# ---- what files declare ------------------------------------------------------------------------------


@pytest.mark.slow
def test_declared__every_file_of_a_sound_run_is_as_planned(sound):
    declared = Declared(plan_of(sound))
    cube = sound / "cube.zarr"
    files = sorted((f for f in cube.rglob("*") if f.is_file()), key=lambda f: f.name != "zarr.json")
    assert len(files) > 20
    for file in files:
        assert declared.problem(file.relative_to(cube).as_posix(), file.read_bytes()) is None


@pytest.mark.parametrize("key", ["section/c.0.0.0.0.0", "status/c.0.0.0", "x_0/c.0", "state/c.0"])
def test_declared__bombs_and_cut_chunks_are_refused_by_what_they_declare(sound, key):
    declared = Declared(plan_of(sound))
    for n_bytes in (2**31 - 17, 2**32 - 1, 16_000_000):
        content = bytes(4) + n_bytes.to_bytes(4, "little") + bytes(16)
        assert declared_bytes(content) == n_bytes
        assert str(n_bytes) in declared.problem(key, content)
    assert declared.problem(key, b"") is not None
    assert declared.problem(key, b"\x02\x01\x21") is not None


def test_declared__texts_are_as_many_as_there_is_room_for(sound):
    declared = Declared(plan_of(sound))
    cube = sound / "cube.zarr" / "state"
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
def test_declared__metadata_of_other_shapes_and_codecs(sound, change, words):
    declared = Declared(plan_of(sound))
    data = json.loads((sound / "cube.zarr" / "section" / "zarr.json").read_bytes())
    assert words in declared.problem("section/zarr.json", json.dumps({**data, **change}).encode())
    assert declared.problem("section/zarr.json", b"[" * 100_000) == "is no metadata of an array"


def committed(directory, key, content):
    """Put a chunk in place with a record that vouches for it, as who made the directory could."""
    opened = RunDirectory.open(directory)
    commits = dict(read_commits(opened.info, opened.plan))
    for commit in commits.values():
        if key in commit.objects:
            objects = dict(commit.objects)
            objects[key] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            object.__setattr__(commit, "objects", objects)
    (directory / "cube.zarr" / key).write_bytes(content)
    return RunDirectory(opened.info, opened.spec, opened.plan, commits)


@pytest.mark.parametrize("key", ["section/c.0.0.0.0.0", "n_steps/c.0.0.0"])
@pytest.mark.parametrize("check", [True, False])
def test_cube__bombs_are_not_decompressed(hostile, key, check, monkeypatch):
    opened = committed(hostile, key, bomb(2**31 - 17))

    def decompress(*arguments, **options):
        raise AssertionError("it was decompressed")

    name = key.partition("/")[0]
    cube = opened.cube(check=check).reset_coords(drop=True)
    monkeypatch.setattr(numcodecs.blosc, "decompress", decompress)
    monkeypatch.setattr(numcodecs.blosc.Blosc, "decode", decompress, raising=False)
    with pytest.raises(DamagedError, match="declares 2147483631 bytes, and has"):
        cube[name].load()


@pytest.mark.slow
def test_open_product__bombs_are_computed_again(hostile):
    product = next((hostile / "derived").glob("attractors-*.zarr"))
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
    derive(hostile, "attractors", QUICK, echo=said.append)
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
def test_commands__execute_nothing_of_a_run_directory(hostile, tmp_path):
    """Opening, verifying, analysing and drawing: no import, no pickle, no process, no file outside."""
    for name in ("sitecustomize.py", "numpy.py", "__init__.py", "conftest.py", "duffing.py", "BOOM.py"):
        (hostile / name).write_text("raise SystemExit('BOOM')")
    (hostile / "derived" / "evil.pkl").write_bytes(b"cos\nsystem\n(S'touch BOOM'\ntR.")
    (hostile / "cube.zarr" / "evil").symlink_to("/etc/passwd")
    (hostile / "commits" / "passwd.json").symlink_to("/etc/passwd")
    # the compiled code of the analyses comes from the cache, whose pickles are the user's own
    place = str(hostile)
    commands = [["status", place], ["verify", place], ["plot", "bifurcation", place], ["status", place, "--json"]]
    script = tmp_path / "watched.py"
    script.write_text(WATCHED.format(place=place, commands=commands))
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'pipeline' / 'face'}", "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=hostile,
        env=environment,
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )
    assert "SEEN []" in done.stdout, done.stdout + done.stderr
    assert "raised" not in done.stderr
    assert not (hostile / "BOOM").exists()
    assert (hostile / "figures").is_dir()


def test_open__a_run_file_that_is_nested_too_deep(hostile):
    """With a checksum that fits, as who made the directory could write it."""
    text = json.dumps(unseal((hostile / "run.json").read_bytes()))
    (hostile / "run.json").write_text(seal(text.replace('"small"', "[" * 100_000 + "]" * 100_000, 1)))
    with pytest.raises((DamagedError, ValueError)):
        RunDirectory.open(hostile)


# ---- folders that cannot be written to -----------------------------------------------------------------


def test_derive__says_before_computing_that_nothing_is_kept(hostile):
    """A file in the place of the folder: not even root writes there."""
    shutil.rmtree(hostile / "derived")
    (hostile / "derived").write_text("")
    said = []
    found = derive(hostile, "attractors", QUICK, echo=said.append)
    assert "is no folder: the result of attractors is shown but not kept" in said[0]
    assert "attractors: computed" in said[-2]
    assert "not kept" in said[-1]
    assert found.sizes


def test_plot__a_figure_that_cannot_be_written_is_refused_before_it_is_drawn(hostile, monkeypatch, main):
    from pipeline.runs import drawing

    (hostile / "figures").write_text("")

    def drawn(*arguments):
        raise AssertionError("it was drawn")

    monkeypatch.setattr(drawing, "drawn", drawn)
    code, _, said = main("plot", "bifurcation", hostile)
    assert code == 2
    assert "figures: is no folder; give another place for the figure: --out FILE." in said
