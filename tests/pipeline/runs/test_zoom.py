"""Specifications derived from others: what changes, what stays, and what is refused."""

from __future__ import annotations

import tomllib
from unicodedata import category

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.layout.cells import coordinates
from pipeline.runs.preview import describe_plan
from pipeline.runs.zoom import Changes, read_source, to_toml, write_zoom, zoom
from pipeline.specification.files import shipped_workflows
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from pipeline.store.runfile import read_run
from tests.pipeline.factories import quietly


@pytest.fixture
def sweep(sweep_text):
    return Spec.parse(tomllib.loads(sweep_text))


@pytest.fixture
def walk(walk_text):
    return Spec.parse(tomllib.loads(walk_text))


LIST = """
kind = "sweep"
title = "a \\"list\\"\\u00a0\\\\ of é"
[parameters]
frequency_hz = 2.2
overrides = { q = 1.6, duty_cycle = 0.5 }
[initial_conditions]
kind = "list"
points_deg = [[1, 2], [3, 4, 5.5, -6e-20]]
"""


def differing(old, new):
    """Tables that differ, as plain data."""
    a, b = old.as_dict(), new.as_dict()
    return {name for name in a.keys() | b.keys() if a.get(name) != b.get(name)}


TITLES = st.text().filter(lambda text: all(c.isprintable() or category(c) == "Zs" for c in text))


def test_to_toml__reads_back(sweep, walk):
    specs = [sweep, walk, Spec.parse(tomllib.loads(LIST))]
    specs += [Spec.parse(tomllib.loads(f"{LIST}\n[products.lyapunov]\nn_exponents = 2"))]
    specs += [Spec.read(path) for path in shipped_workflows().values()]
    for spec in specs:
        text = to_toml(spec)
        assert Spec.parse(tomllib.loads(text)) == spec
        # an equation or a state of a model stays in one line, and so does an initial state
        tables, _, _ = text.partition("\n[model]")
        assert max(len(line) for line in tables.splitlines() if not line.startswith("    [")) < 120


@pytest.mark.slow
@given(TITLES, st.floats(0.1, 10.0), st.floats(-1e-300, 1e300))
def test_to_toml__any_title_and_number(title, frequency, angle):
    data = tomllib.loads(LIST)
    data["title"] = title
    data["parameters"]["frequency_hz"] = frequency
    data["initial_conditions"] = {"kind": "grid", "psi1": angle}
    spec = Spec.parse(data)
    assert Spec.parse(tomllib.loads(to_toml(spec))) == spec


def test_zoom__grid(sweep):
    new, notes = zoom(sweep, Changes({"psi1_deg": (-3, 4), "psi2": (0.1, 0.2)}, num=50, nums={"psi2": 7}))
    assert differing(sweep, new) == {"title", "initial_conditions"}
    assert new.title == "small sweep (zoom)"
    assert notes == []
    found = {c.name: c.values for c in coordinates(new)}
    assert np.allclose(found["psi1_0"], np.deg2rad(np.linspace(-3, 4, 50)), rtol=1e-15, atol=1e-16)
    assert np.allclose(found["psi2_0"], np.linspace(0.1, 0.2, 7), rtol=1e-15)
    assert found["psi1_dot_0"] == 0.1
    again, _ = zoom(new, Changes({"psi1_deg": (0, 1)}))
    assert again.title == new.title
    assert len(again.initial_conditions.of("psi1_deg").array()) == 50


def test_zoom__beyond_the_old_range_is_noted(sweep):
    radians, _ = zoom(sweep, Changes({"psi1": (-0.5, 0.5)}))
    for spec, key, pair, noted in [
        (sweep, "psi1_deg", (-30, 30), False),
        (sweep, "psi1_deg", (0, 30.1), True),
        (sweep, "psi1", (-np.pi / 6, np.pi / 6), False),
        (sweep, "psi1", (0, 0.53), True),
        (sweep, "frequency_hz", (2.0, 3.0), False),
        (sweep, "frequency_hz", (1.9, 2.0), True),
        (radians, "psi1_deg", (-28, 28), False),
        (radians, "psi1_deg", (-29, 0), True),
    ]:
        _, notes = zoom(spec, Changes({key: pair}))
        assert len(notes) == noted, (key, pair)
        assert all(note.startswith(f"{key}: ") and "beyond the old" in note for note in notes)
    # a state that was fixed becomes a range
    new, notes = zoom(sweep, Changes({"psi1_dot": (0, 1)}, nums={"psi1_dot": 6}))
    assert notes == []
    assert len(new.initial_conditions.of("psi1_dot").array()) == 6


def test_zoom__parameters(sweep):
    new, _ = zoom(sweep, Changes({"q": (1.52, 1.55)}, {"frequency_hz": 2.2}))
    assert new.parameters.frequency_hz == 2.2
    assert list(new.axes) == ["q"]
    assert new.axes["q"].array().tolist() == [1.52, 1.55]
    new, _ = zoom(new, Changes({"frequency_hz": (2.1, 2.3)}, {"q": 1.53, "eps": 900.0}, num=3))
    assert new.parameters.frequency_hz is None
    assert new.axes["frequency_hz"].array().tolist() == [2.1, 2.2, 2.3]
    assert new.parameters.overrides == {"q": 1.53, "eps": 900.0}
    new, _ = zoom(new, Changes({"q": (1, 2)}, {"psi1_deg": 3.0}, nums={"q": 2}))
    assert new.parameters.overrides == {"eps": 900.0}
    assert new.initial_conditions.of("psi1_deg") == 3.0


def test_zoom__samples(walk):
    new, _ = zoom(walk, Changes({"psi1": (-0.1, 0.1), "frequency_hz": (2.1, 2.2)}, num=8, samples=9))
    starts = new.initial_conditions
    assert starts.given == {"psi1": (-0.1, 0.1), "psi2_deg": (-40, 40)}
    assert (starts.n, starts.seed) == (9, 3)
    assert len(new.axes["frequency_hz"].array()) == 8
    assert new.continuation == walk.continuation
    assert zoom(walk, Changes({"psi1": (-0.1, 0.1)}))[0].initial_conditions.n == 5


REFUSED = [
    (Changes(), "nothing to change"),
    (Changes({"psi1": (1, 1)}), "psi1 = 1 1: the second number must be greater"),
    (Changes({"psi1": (0, float("inf"))}), "finite"),
    (Changes({"psi1": (0, 1), "psi1_deg": (0, 1)}), "psi1: is changed twice"),
    (Changes({"q": (1, 2)}, {"q": 1}), "q: is changed twice"),
    (Changes({"psi1": (0, 1)}, num=1), "psi1: a range has 2 points or more"),
    (Changes({"psi1": (0, 1)}, nums={"psi2": 3}), "psi2: no range is given for it"),
    (Changes({"psi1": (0, 1)}, samples=3), "samples = 3: the initial conditions are not random"),
    (Changes({}, {"q": 1.5}, num=3), "num = 3: no new range has points"),
    (Changes({}, {"frequency_hz": -2.0}), "parameters.frequency_hz = -2.0"),
]


def test_zoom__refused(sweep, walk):
    for changes, message in REFUSED:
        with pytest.raises(SpecError) as caught:
            zoom(sweep, changes)
        assert any(message in p for p in caught.value.problems), caught.value.problems
    with pytest.raises(SpecError, match="a list, which has no ranges"):
        zoom(Spec.parse(tomllib.loads(LIST)), Changes({"psi1": (0, 1)}))
    for changes, message in (
        (Changes({"psi1": (0, 1)}, num=4), "num = 4: no new range has points"),
        (Changes({"psi1": (0, 1)}, nums={"psi1": 4}), "random samples have no grid"),
        (Changes({}, {"frequency_hz": 2.2}), r"continuation\.path"),
    ):
        with pytest.raises(SpecError, match=message):
            zoom(walk, changes)


def test_zoom__refinement_must_fit(sweep_text):
    text = sweep_text.replace('"grid"', '"grid"\nrefine = 2')
    spec = Spec.parse(tomllib.loads(text))
    assert zoom(spec, Changes({"psi1": (0, 1)}))[0].refine == 2
    with pytest.raises(SpecError, match="there is no range to refine"):
        zoom(spec, Changes({}, {"psi1": 0.0, "psi2": 0.0}))


def test_write_zoom__from_a_run(write_spec, sweep_text, tmp_path):
    text = sweep_text + "\n[smoke]\naxes.frequency_hz.num = 2\n"
    directory = tmp_path / "run"
    quietly(write_spec(text), directory, smoke=True)
    out = tmp_path / "zoom.toml"
    assert write_zoom(read_source(directory), Changes({"psi1": (0.0, 0.1)}), out) == []
    head, *rest = out.read_text("utf-8").splitlines()
    assert head == f"# Zoom. Derived from run run, digest {read_run(directory).digest}."
    assert rest[0] == 'kind = "sweep"'
    # what was run, not what the file would have run in full
    assert len(Spec.read(out).axes["frequency_hz"].array()) == 2
    assert "48 cells" in "\n".join(describe_plan(out, None))
    before = out.read_bytes()
    for target, message in [(out, "exists already"), (tmp_path / "no" / "z.toml", "no such folder")]:
        with pytest.raises(SpecError, match=message):
            write_zoom(read_source(directory), Changes({"psi1": (0.0, 0.2)}), target)
    assert out.read_bytes() == before


def test_zoom__command(main, write_spec, sweep_text, tmp_path):
    path = write_spec(sweep_text)
    ranges = ["--psi1-deg", -5, 35, "--num-psi1", 9, "--axis", "q=1.5:1.6:11", "--at", "frequency_hz=2.2"]
    code, out, said = main("zoom", path, *ranges, "--out", "zoom.toml")
    assert code == 0, said
    assert out == "specification: zoom.toml\n"
    assert "note: psi1_deg: -5 to 35 reaches beyond the old -30 to 30." in said
    new = Spec.read(tmp_path / "zoom.toml")
    assert (tmp_path / "zoom.toml").read_text().startswith("# Zoom. Derived from specification spec.toml.\n")
    assert len(new.initial_conditions.of("psi1_deg").array()) == 9
    assert len(new.axes["q"].array()) == 11
