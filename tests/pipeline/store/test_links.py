"""Links at every path of a run directory that a command writes: what they lead to is never touched."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from pipeline.runs.derive import derive, prune
from pipeline.store.errors import RefusedError, StoreError
from pipeline.store.products import open_product
from pipeline.store.run import open_run
from tests.pipeline.factories import SQUARE, duffing, finished

SPEC = duffing(
    "amplitude = { start = 0.2, stop = 0.3, num = 3 }",
    SQUARE,
    n_transient=30,
    n_keep=8,
    more="[parameters]\nfrequency_hz = 0.2",
)

RUN = ("run", "spec.toml", "--out", "run", "--workers", 0)
VERIFY = ("verify", "--repair", "run")
EXTEND = ("extend", "run", "--axis", "amplitude=0.2:0.3:5", "--workers", 0)
PLOT = ("plot", "bifurcation", "run")
ANALYSE = ("analyse", "attractors", "run", "--no-polish", "--no-extend")
WRITERS, DRAWERS, ANALYSTS = (RUN, VERIFY, EXTEND), (PLOT,), (ANALYSE,)

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
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("links")
    derive(finished(folder, SPEC), "attractors", {"polish": False, "extend": False})
    return folder


@pytest.fixture
def whole(sound, tmp_path):
    """A copy of a finished run with a product."""
    shutil.copytree(sound, tmp_path, dirs_exist_ok=True)
    return tmp_path / "run"


def content_of(path: Path):
    """All that is below a path, byte for byte."""
    if path.is_dir():
        return {f.relative_to(path): f.read_bytes() for f in sorted(path.rglob("*")) if f.is_file()}
    return path.read_bytes() if path.exists() else None


IN_TABLE = ("run.json", "commits", "cube.zarr")
"""Links from these places to the same content: test_damage."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "kind"),
    [(p, k) for p in PLACES for k in ("same", "dangling") if k == "dangling" or not p.startswith(IN_TABLE)],
)
def test_commands__write_through_no_link(whole, main, tmp_path, place, kind):
    commands = PLACES[place]
    if commands is ANALYSTS:
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


@pytest.mark.parametrize("what", ["chunk", "chunk later", "zarr.json", "folder", "product file", "product"])
def test_open_run__links_are_not_followed_out(whole, tmp_path, what):
    """Whatever is behind a link, with the same bytes or not: it is not read as a part of the run."""
    product = next((whole / "derived").glob("attractors-*.zarr"))
    place = {
        "zarr.json": whole / "cube.zarr" / "section" / "zarr.json",
        "folder": whole / "cube.zarr" / "section",
        "product file": product / "zarr.json",
        "product": product,
    }.get(what, whole / "cube.zarr" / "section" / "c.0.0.0.0.0")
    opened = open_run(whole)
    place.rename(tmp_path / "outside")
    place.symlink_to(tmp_path / "outside")
    if what == "chunk":  # nothing vouches for a link: its cells are pending
        assert np.isnan(open_run(whole).section.values).all()
        return
    uses = {"chunk later": opened.section.load, "product": lambda: open_product(product)}
    use = uses.get("product" if what == "product file" else what, lambda: open_run(whole))
    with pytest.raises((StoreError, OSError), match=r"link|is missing"):
        use()


def test_prune__links_are_not_followed(whole, tmp_path):
    derived, outside = whole / "derived", tmp_path / "outside"
    (outside / "x.zarr").mkdir(parents=True)
    (outside / "x.zarr/kept").write_text("x")
    (derived / "mean-1.zarr").symlink_to(outside / "x.zarr")
    prune(whole)
    assert not (derived / "mean-1.zarr").is_symlink()
    shutil.rmtree(derived)
    derived.symlink_to(outside)
    with pytest.raises(RefusedError, match="derived: is a link"):
        prune(whole)
    assert (outside / "x.zarr/kept").read_text() == "x"
