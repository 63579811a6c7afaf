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
from pipeline.runs.run import run
from pipeline.specification.parsing import kept_spec
from pipeline.store.declared import Declared, declared_bytes
from pipeline.store.errors import DamagedError, StoreError
from pipeline.store.run import Run, open_run
from pipeline.store.runfile import read_run

ROOT = Path(__file__).parents[3]
SPEC = """
kind = "sweep"
model = "duffing"
title = "small"
[parameters]
frequency_hz = 0.2
[axes]
amplitude = { start = 0.2, stop = 0.3, num = 3 }
[initial_conditions]
kind = "grid"
x = { start = -1.0, stop = 1.0, num = 3 }
v = { start = -1.0, stop = 1.0, num = 3 }
[integration]
n_transient = 30
n_keep = 8
"""


QUICK = {"polish": False, "extend": False}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A finished run with a derived product."""
    folder = tmp_path_factory.mktemp("sound")
    spec = folder / "spec.toml"
    spec.write_text(SPEC)
    run(spec, folder / "run", workers=0, echo=lambda line: None)
    derive(folder / "run", "attractors", QUICK)
    return folder / "run"


@pytest.fixture
def hostile(sound, tmp_path):
    """A copy of the run to be changed."""
    return Path(shutil.copytree(sound, tmp_path / "run"))


def plan_of(directory):
    return make_plan(kept_spec(read_run(directory).spec))


def bomb(n_bytes):
    """A chunk of a few bytes that declares many, in the codecs of the cube."""
    content = bytearray(numcodecs.blosc.compress(np.zeros(1000), b"lz4", 5, 1))
    content[4:8] = n_bytes.to_bytes(4, "little")
    return bytes(content) + bytes(4)


# ---- what files declare ------------------------------------------------------------------------------


def test_declared__every_file_of_a_sound_run_is_as_planned(sound):
    declared = Declared(plan_of(sound))
    cube = sound / "cube.zarr"
    files = sorted((f for f in cube.rglob("*") if f.is_file()), key=lambda f: f.name != "zarr.json")
    assert len(files) > 20
    for file in files:
        assert declared.problem(file.relative_to(cube).as_posix(), file.read_bytes()) is None


@pytest.mark.parametrize("key", ["section/c.0.0.0.0.0", "status/c.0.0.0", "x_0/c.0", "state/c.0"])
@pytest.mark.parametrize("n_bytes", [2**31 - 17, 2**32 - 1, 16_000_000])
def test_declared__bombs_are_refused_by_what_they_declare(sound, key, n_bytes):
    declared = Declared(plan_of(sound))
    content = np.int64(0).tobytes() + bytes(8)
    assert declared_bytes(bytes(4) + n_bytes.to_bytes(4, "little") + content) == n_bytes
    problem = declared.problem(key, bytes(4) + n_bytes.to_bytes(4, "little") + content)
    assert problem is not None
    assert str(n_bytes) in problem


def test_declared__empty_and_cut_chunks(sound):
    declared = Declared(plan_of(sound))
    for key in ("section/c.0.0.0.0.0", "x_0/c.0"):
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
    from pipeline.store.commits import read_commits

    opened = Run.open(directory)
    commits = dict(read_commits(opened.info, opened.plan))
    for commit in commits.values():
        if key in commit.objects:
            objects = dict(commit.objects)
            objects[key] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            object.__setattr__(commit, "objects", objects)
    (directory / "cube.zarr" / key).write_bytes(content)
    return Run(opened.info, opened.spec, opened.plan, commits)


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


def test_open_product__bombs_are_computed_again(hostile):
    product = next((hostile / "derived").glob("attractors-*.zarr"))
    chunk = next(f for f in sorted(product.rglob("c*")) if f.is_file())
    chunk.write_bytes(bomb(2**31 - 17))
    from pipeline.store import products
    from pipeline.store.places import open_files

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


# ---- links ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["chunk", "zarr.json", "folder", "product file", "product"])
def test_open_run__links_are_not_followed_out(hostile, tmp_path, what):
    """Whatever is behind a link, with the same bytes or not: it is not read as a part of the run."""
    product = next((hostile / "derived").glob("attractors-*.zarr"))
    place = {
        "chunk": hostile / "cube.zarr" / "section" / "c.0.0.0.0.0",
        "zarr.json": hostile / "cube.zarr" / "section" / "zarr.json",
        "folder": hostile / "cube.zarr" / "section",
        "product file": product / "zarr.json",
        "product": product,
    }[what]
    outside = tmp_path / "outside"
    place.rename(outside)
    place.symlink_to(outside)
    if what.startswith("product"):
        from pipeline.store.products import open_product

        with pytest.raises(DamagedError, match="link"):
            open_product(product)
    elif what == "chunk":  # nothing vouches for a link: its cells are pending
        assert np.isnan(open_run(hostile).section.values).all()
    else:
        with pytest.raises(StoreError, match="link"):
            open_run(hostile)


def test_cube__a_chunk_that_becomes_a_link_is_not_read(hostile, tmp_path):
    cube = open_run(hostile)
    place = hostile / "cube.zarr" / "section" / "c.0.0.0.0.0"
    place.rename(tmp_path / "outside")
    place.symlink_to(tmp_path / "outside")
    with pytest.raises((StoreError, OSError), match=r"is a link|is missing"):
        cube.section.load()


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


@pytest.mark.parametrize("depth", [100_000, 200])
def test_commands__a_run_file_that_is_nested_too_deep(hostile, depth):
    text = (hostile / "run.json").read_text("utf-8")
    (hostile / "run.json").write_text(text.replace('"small"', "[" * depth + "]" * depth, 1))
    with pytest.raises((DamagedError, ValueError)):
        Run.open(hostile)


def test_commands__a_model_that_names_an_object_is_not_imported(hostile):
    """A run.json that names a module and an object of it is a description; it is never imported."""
    module = hostile / "boom_module.py"
    module.write_text("raise AssertionError('imported')")
    path = hostile / "run.json"
    path.write_text(path.read_text("utf-8").replace('"duffing"', '"boom_module:MODEL"'))
    with pytest.raises((DamagedError, ValueError)):
        Run.open(hostile)
    assert "boom_module" not in sys.modules


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


def test_plot__a_figure_that_cannot_be_written_is_refused_before_it_is_drawn(hostile, monkeypatch, capsys):
    from pipeline.cli.main import main
    from pipeline.runs import drawing

    (hostile / "figures").write_text("")

    def drawn(*arguments):
        raise AssertionError("it was drawn")

    monkeypatch.setattr(drawing, "drawn", drawn)
    monkeypatch.setattr(sys, "argv", ["magpend", "plot", "bifurcation", str(hostile)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 2
    assert "figures: is no folder; give another place for the figure: --out FILE." in capsys.readouterr().err
