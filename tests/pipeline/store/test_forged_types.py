"""Values of another type in stored JSON, under checksums that fit, are named by one error and never a traceback."""

from __future__ import annotations

import contextlib
import json
import random

import pytest
import xarray as xr

from pipeline import open_run
from pipeline.layout.identity import digest_of
from pipeline.runs.status import describe_state, state
from pipeline.runs.verify import describe, verify_run
from pipeline.store import products
from pipeline.store.commits import marker_key
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.records import BLOCK, Pack, Records, pack_key, pack_text, read_pack, read_record
from pipeline.store.stored_json import seal, unseal

FORGED = [7, "12", None, True, [1, "a"], {"a\0b": 1}, float("nan"), -(10**400)]


def leaves(data, path=()):
    """Paths of all values below the top."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from leaves(value, (*path, key))


def put(data, path, value):
    changed = json.loads(json.dumps(data))
    place = changed
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return changed


def forgeries(data, per_value=2):
    """Each value of a JSON document replaced by values of other types, drawn by the path."""
    for path in leaves(data):
        for value in random.Random(repr(path)).sample(FORGED, per_value):
            yield path, put(data, path, value)


def problem_of(read, place):
    """The message of the error that a user may see; any other error fails the test."""
    try:
        read(place)
    except (DamagedError, RefusedError) as error:
        return str(error)
    return None


def look(directory):
    """What `status`, `verify` and `open_run` do with a run."""
    describe_state(state(directory))
    describe(verify_run(directory), directory, repaired=False)
    open_run(directory).load()


@pytest.mark.slow
def test_run_file__of_other_types(made):
    made.commit(0)
    path = made.info.directory / "run.json"
    whole = unseal(path.read_bytes())
    outcomes = []
    for key, data in forgeries(whole, 1):
        with contextlib.suppress(ValueError):  # an identity without a digest: NaN
            data["digest"] = digest_of(data["identity"]) if key[0] == "identity" else data["digest"]
        path.write_bytes(seal(json.dumps(data)).encode())
        problem = problem_of(look, made.info.directory)
        assert problem is None or str(made.info.directory) in problem
        outcomes.append(problem is not None)
    assert sum(outcomes) > len(outcomes) / 2


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        (("title",), 7, "title = 7"),
        (("skeleton", "zarr.json", "size"), "12", "skeleton.zarr.json.size = '12'"),
        (("skeleton", "a\0b"), {"size": 1, "sha256": "0" * 64}, "is not the path of a file"),
        (("versions",), None, "versions = None"),
        (("spec", "axes"), float("nan"), "axes"),
    ],
)
def test_run_file__the_command_names_what_is_wrong(made, main, key, value, named):
    path = made.info.directory / "run.json"
    path.write_bytes(seal(json.dumps(put(unseal(path.read_bytes()), key, value))).encode())
    for command in ("status", "verify"):
        code, _, err = main(command, made.info.directory)
        assert code == 5
        assert f"{path}: " in err
        assert named in err


@pytest.mark.slow
def test_record__of_other_types(made):
    for index in range(2):
        made.commit(index)
    path = made.info.directory / marker_key(1)
    n_damaged = 0
    for _, data in forgeries(unseal(path.read_bytes())):
        path.write_bytes(seal(json.dumps(data)).encode())
        look(made.info.directory)
        n_damaged += not verify_run(made.info.directory).sound
    assert n_damaged > 10
    verify_run(made.info.directory, repair=True)
    assert verify_run(made.info.directory).sound


@pytest.mark.slow
def test_pack__of_other_types(made):
    made.commit(0)
    info = made.info
    commit = read_record((info.directory / marker_key(0)).read_bytes(), info.digest)
    content = pack_text({0: commit}, info.digest, 0)
    line, last = content.splitlines(keepends=True)
    assert isinstance(read_pack(content, info.digest, 0), Pack)
    for path, data in forgeries(unseal_last(last)):
        forged = line + seal(json.dumps(data), line).encode()
        found = read_pack(forged, info.digest, 0)
        assert isinstance(found, str) or found.cells == {"bounded": 7}, path
    body = seal(json.dumps({"digest": info.digest, "task": 0, "status": [], "objects": 7})).encode()
    forged = body + seal(json.dumps(unseal_last(last)), body).encode()
    info.files.write(pack_key(0), forged)
    records = Records(info.files, info.digest, {}, {0: Pack(0, {"bounded": 24}, tuple(range(1, BLOCK)))})
    with pytest.raises(DamagedError, match="record of task 0 is torn or damaged"):
        records[0]


def unseal_last(line):
    data = json.loads(line)
    del data["checksum"]
    return data


@pytest.mark.slow
def test_product__of_other_types(made):
    place = made.info.directory / "derived/mean-12345678.zarr"
    labels = xr.DataArray(["in", "out", "in"], dims="place")
    attrs = {"derived_product": "attractors", "cube_digest": made.info.digest, "derived_options": "{}"}
    ds = xr.Dataset({"mean": ("place", [1.0, 2.0, 3.0])}, {"side": labels}, attrs)
    products.write_product(place, ds)
    whole = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}
    group = json.loads(whole[place / "zarr.json"])
    cases = [(None, changed) for path, changed in forgeries(group) if path[0] != "consolidated_metadata"]
    for name in ("mean", "side"):
        cases += [(name, changed) for _, changed in forgeries(json.loads(whole[place / name / "zarr.json"]))]
    for name, changed in cases:
        data = changed if name is None else json.loads(json.dumps(group))
        if name is not None:
            (place / name / "zarr.json").write_text(json.dumps(changed))
            data["consolidated_metadata"]["metadata"][name] = changed
        if isinstance(own := data["attributes"], dict) and products.SEAL in own:
            own[products.SEAL] = products._seal(own, products._digests(products.open_files(place)))
        (place / "zarr.json").write_text(json.dumps(data))
        for read in (products.read_product_attrs, products.open_product):
            problem = problem_of(read, place)
            assert problem is None or str(place) in problem
        describe(verify_run(made.info.directory), made.info.directory, repaired=False)
        for path, content in whole.items():
            path.write_bytes(content)
