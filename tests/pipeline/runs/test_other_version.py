"""A run that another version has begun is not continued, and the message names what works with it."""

from __future__ import annotations

import json

import pytest

from pipeline.cli.exits import Exit
from pipeline.layout.identity import digest_of
from pipeline.store.checksums import seal, unseal
from pipeline.store.commits import marker_key
from pipeline.store.files import entry_of
from tests.pipeline.factories import duffing, quietly

pytestmark = pytest.mark.slow

SPEC = duffing(
    "frequency_hz = { start = 0.15, stop = 0.25, num = 3 }",
    'kind = "list"\npoints = [[0.5, 0.0]]',
    n_transient=40,
    execution="trajectories_per_task = 1",
)


def made_by(directory, **changes):
    """Let another version have made a run: rewrite its identity, and the digest in all its files."""
    data = unseal((directory / "run.json").read_bytes())
    before = data["digest"]
    data["identity"] = {key: value for key, value in (data["identity"] | changes).items() if value is not None}
    after = data["digest"] = digest_of(data["identity"])
    group = directory / "cube.zarr/zarr.json"
    group.write_text(group.read_text().replace(before, after))
    content = group.read_bytes()
    data["skeleton"]["zarr.json"] = entry_of(content)
    (directory / "run.json").write_bytes(seal(json.dumps(data)).encode())
    for path in (directory / "commits").glob("*.json"):
        record = unseal(path.read_bytes())
        path.write_bytes(seal(json.dumps({**record, "digest": after}, sort_keys=True)).encode())
    (directory / "records.jsonl").unlink(missing_ok=True)


FIRST = {
    "kernel_version": "433ffff3fca2c718",
    "code": {
        "compute.integrate": "8d946736bc2d348c",
        "compute.task": "e9ce1f0744f9cc3c",
        "layout.cells": "8f83262db4988cca",
    },
}
"""Versions as runs had them when they were digests of source code."""


def begun_by(write_spec, tmp_path, **versions):
    """Return the specification and the directory of a run that code of other versions has begun, without its last task;
    and the bytes of that task.
    """
    spec, directory = write_spec(SPEC), tmp_path / "begun"
    quietly(spec, directory)
    made_by(directory, **versions)
    last = directory / marker_key(2)
    content = last.read_bytes()
    last.unlink()
    return spec, directory, content


def test_run__of_versions_that_were_digests_goes_on(write_spec, tmp_path):
    spec, directory, last = begun_by(write_spec, tmp_path, versions=None, **FIRST)
    before = (directory / "run.json").read_bytes()
    quietly(spec, directory)
    assert (directory / marker_key(2)).read_bytes() == last
    assert (directory / "run.json").read_bytes() == before


@pytest.mark.parametrize(
    "versions",
    [
        {"versions": {"engine": 1000, "cells": 1}},
        {"versions": None, **FIRST, "kernel_version": "0123456789abcdef"},
        {"versions": None, **FIRST, "code": FIRST["code"] | {"compute.task": "0123456789abcdef"}},
    ],
)
def test_run__of_another_version(main, write_spec, tmp_path, versions):
    spec, directory, _ = begun_by(write_spec, tmp_path, **versions)
    code, _, err = main("run", spec, "--out", directory, "--workers", "0")
    assert code == Exit.REFUSED
    for words in ("another version of magpend", "finished cells stay", "status, analyse, plot", "--out ANOTHER"):
        assert words in err
    for command in (["status"], ["verify"], ["analyse", "attractors"], ["plot", "bifurcation"]):
        code, _, err = main(*command, directory)
        assert code == Exit.DONE, err
    assert main("run", spec, "--out", tmp_path / "anew", "--workers", "0")[0] == Exit.DONE
    assert (
        main("extend", directory, "--axis", "frequency_hz=0.15:0.35:5", "--out", tmp_path / "wide")[0] == Exit.REFUSED
    )
