"""A run that another version has begun is not continued, and the message names what works with it."""

from __future__ import annotations

import json

import pytest

from pipeline.cli.exits import Exit
from pipeline.layout.identity import digest_of
from pipeline.runs.run import run
from pipeline.store.checksums import seal, unseal
from pipeline.store.commits import marker_key
from pipeline.store.files import entry_of

pytestmark = pytest.mark.slow

SPEC = """
kind = "sweep"
model = "duffing"
[axes]
frequency_hz = { start = 0.15, stop = 0.25, num = 3 }
[initial_conditions]
kind = "list"
points = [[0.5, 0.0]]
[integration]
rtol = 1e-6
atol = 1e-6
n_transient = 40
n_keep = 3
[execution]
trajectories_per_task = 1
"""


def made_by(directory, **changes):
    """Let another version have made a run: rewrite its identity, and the digest in all its files."""
    data = unseal((directory / "run.json").read_bytes())
    before = data["digest"]
    data["identity"] |= changes
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


@pytest.mark.parametrize("key", ["kernel_version", "code"])
def test_run__of_another_version(main, write_spec, tmp_path, key):
    spec = write_spec(SPEC)
    directory = tmp_path / "begun"
    run(spec, directory, workers=0, echo=lambda _: None)
    (directory / marker_key(2)).unlink()
    made_by(directory, **{key: "earlier" if key == "kernel_version" else {"compute.task": "earlier"}})
    code, _, err = main("run", spec, "--out", directory, "--workers", "0")
    assert code == Exit.REFUSED
    for words in (
        "another version of magpend",
        "finished cells stay",
        "status, analyse, plot or report",
        "--out ANOTHER",
    ):
        assert words in err
    for command in (["status"], ["verify"], ["analyse", "attractors"], ["plot", "bifurcation"]):
        code, _, err = main(*command, directory)
        assert code == Exit.DONE, err
    assert main("run", spec, "--out", tmp_path / "anew", "--workers", "0")[0] == Exit.DONE
    assert (
        main("extend", directory, "--axis", "frequency_hz=0.15:0.35:5", "--out", tmp_path / "wide")[0] == Exit.REFUSED
    )
