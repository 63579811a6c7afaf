"""Links at every path of a run directory that a command writes: what they lead to is never touched."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pipeline.runs.run import run

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

RUN = ("run", "spec.toml", "--out", "run", "--workers", 0)
VERIFY = ("verify", "--repair", "run")
EXTEND = ("extend", "run", "--axis", "amplitude=0.2:0.3:5", "--workers", 0)
PLOT = ("plot", "bifurcation", "run")
ANALYSE = ("analyse", "attractors", "run", "--no-polish", "--no-extend")
REPORT = ("report", "run", "--out", "report.html", "--only-stored")
WRITERS, DRAWERS, ANALYSTS = (RUN, VERIFY, EXTEND), (PLOT,), (ANALYSE, REPORT)

PLACES = {
    "lock": WRITERS,
    "lock.json": WRITERS,
    "timings.jsonl": WRITERS,
    "extended.json": WRITERS,
    "run.json": (RUN, VERIFY),
    "commits": WRITERS,
    "commits/000000.json": WRITERS,
    "cube.zarr": WRITERS,
    "cube.zarr/zarr.json": WRITERS,
    "cube.zarr/section": WRITERS,
    "cube.zarr/section/zarr.json": WRITERS,
    "cube.zarr/section/c.0.0.0.0.0": WRITERS,
    "cube.zarr/x_0/c.0": WRITERS,
    "figures": DRAWERS,
    "figures/{figure}.png": DRAWERS,
    "figures/{figure}.nc": DRAWERS,
    "derived": ANALYSTS,
    "derived/{product}": ANALYSTS,
    "derived/{product}/zarr.json": ANALYSTS,
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("links")
    (folder / "spec.toml").write_text(SPEC)
    run(folder / "spec.toml", folder / "run", workers=0, echo=lambda line: None)
    return folder


@pytest.fixture
def whole(finished, tmp_path, main):
    """A copy of the run with what the commands add to it."""
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    return tmp_path / "run"


def content_of(path: Path):
    """All that is below a path, byte for byte."""
    if path.is_dir():
        return {f.relative_to(path): f.read_bytes() for f in sorted(path.rglob("*")) if f.is_file()}
    return path.read_bytes() if path.exists() else None


@pytest.mark.parametrize("kind", ["of the same content", "dangling"])
@pytest.mark.parametrize("place", PLACES)
def test_commands__write_through_no_link(whole, main, tmp_path, place, kind):
    commands = PLACES[place]
    if commands is ANALYSTS:
        assert main(*ANALYSE)[0] == 0
        place = place.format(product=next((whole / "derived").iterdir()).name)
    if commands is DRAWERS:
        assert main(*PLOT)[0] == 0
        place = place.format(figure=next((whole / "figures").iterdir()).stem)
    outside, path = tmp_path / "outside", whole / place
    if path.exists():
        path.rename(outside)
    else:
        outside.write_text("somebody's\n")
    if kind == "dangling":
        shutil.rmtree(outside) if outside.is_dir() else outside.unlink()
    path.symlink_to(outside)
    before = content_of(outside)
    for command in commands:
        code, _, said = main(*command)
        assert content_of(outside) == before, (command, said)
        assert "Traceback" not in said
        if path.is_symlink() and command in (RUN, PLOT):
            assert code == 2, (command, said)
            assert f"{place}: is a link" in said
