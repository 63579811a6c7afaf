"""What `import magpend` gives beyond the commands."""

from __future__ import annotations

import numpy as np
import pytest

import magpend
from magpend_core.models import ModelError
from pipeline.specification.problems import SpecError

OSCILLATOR = {
    "name": "oscillator",
    "states": {"x": "m", "v": "m/s"},
    "parameters": {"k": 1.0, "A": 0.5},
    "equations": {"x": "v", "v": "-k*x - 0.2*v + A*cos(2*pi*f*t)"},
}
TABLE = {
    "kind": "sweep",
    "title": "three forces",
    "model": OSCILLATOR,
    "axes": {"A": np.array([0.1, 0.2, 0.3])},
    "parameters": {"frequency_hz": 0.2},
    "initial_conditions": {"kind": "list", "points": [[0.0, 0.0], (0.5, np.float64(0.1))]},
    "integration": {"n_transient": 200, "n_keep": 4},
}
TEXT = """
kind = "sweep"
parameters = { frequency_hz = 0.2 }
axes = { A = { values = [0.1, 0.2, 0.3] } }
initial_conditions = { kind = "list", points = [[0.0, 0.0]] }
integration = { n_transient = 20, n_keep = 4 }
[model]
name = "oscillator"
states = { x = "m", v = "m/s" }
parameters = { k = 1.0, A = 0.5 }
equations = { x = "v", v = "-k*x - 0.2*v + A*cos(2*pi*f*t)" }
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    table = {**TABLE, "axes": {"A": {"values": TABLE["axes"]["A"]}}}
    return magpend.run(table, tmp_path_factory.mktemp("made") / "run", workers=0, echo=lambda _: None)


def test_run__of_a_table_is_opened_and_exact(made):
    assert made.complete
    cube = made.cube()
    assert cube.sizes["A"] == 3
    # x = Re(A exp(i w t)/(k - w**2 + .2 i w)) at t = 0
    w = 2.0 * np.pi * 0.2
    expected = (np.array([0.1, 0.2, 0.3]) / (1.0 - w * w + 0.2j * w)).real
    assert cube.section.sel(state="x").isel(period_index=-1, initial_condition=1).values == pytest.approx(
        expected, abs=1e-6
    )


def test_run__of_a_text_goes_on_where_it_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = magpend.run(TEXT, workers=0, echo=lambda _: None)
    assert first.directory.name.startswith("oscillator-")
    said = []
    again = magpend.run(TEXT, workers=0, echo=said.append)
    assert again.directory == first.directory
    assert any("nothing to do" in line for line in said)


def test_repr__tells_what_it_is_and_what_to_do_next(made):
    text = repr(made)
    assert len(text.splitlines()) <= 20
    for words in ("three forces", "oscillator", "6: A (3) x initial_condition (2)", "6 of 6", "run.cube()"):
        assert words in text
    assert repr(magpend.attractors(made)) != text
    assert "<table>" in made._repr_html_()
    assert "three forces" in made._repr_html_()


def test_table__has_a_row_per_attractor_and_parameter_point(made):
    found = magpend.table(magpend.attractors(made))
    assert len(found) == 3
    assert found["A"].tolist() == [0.1, 0.2, 0.3]
    assert set(found["kind"]) == {"periodic_orbit"}
    with pytest.raises(ValueError, match="not the result of an analysis"):
        magpend.table(made.cube())


def test_load_model__from_anywhere(tmp_path):
    whole, alone, named = tmp_path / "spec.toml", tmp_path / "model.toml", tmp_path / "named.toml"
    whole.write_text(TEXT)
    alone.write_text(TEXT.partition("[model]")[2])
    named.write_text('kind = "sweep"\nmodel = "duffing"\n')
    models = [magpend.load_model(given) for given in (OSCILLATOR, TEXT, whole, str(alone), alone.read_text())]
    assert {model.name for model in models} == {"oscillator"}
    assert magpend.load_model(named) is magpend.load_model("duffing")
    with pytest.raises(ModelError, match="does not exist"):
        magpend.load_model("duffin")
    with pytest.raises(SpecError, match="cannot be read"):
        magpend.load_model(tmp_path / "none.toml")


def test_sections__of_one_set_or_of_many():
    model = magpend.load_model(OSCILLATOR)
    sets = [model.load(A=a) for a in (0.1, 0.3)]
    starts = [[0.0, 0.0], [0.0, 0.0]]
    both = magpend.sections(sets, 0.2, starts, n_transient=5, n_keep=2)
    for i, one in enumerate(sets):
        alone = magpend.sections(one, 0.2, starts[:1], n_transient=5, n_keep=2)
        assert np.array_equal(both.section[i], alone.section[0])
    with pytest.raises(ValueError, match="of one model"):
        magpend.sections([sets[0], magpend.load_model("duffing").load()], 0.2, starts, n_transient=0, n_keep=1)
    with pytest.raises(ValueError, match="3 sets for 2 cells"):
        magpend.sections([*sets, sets[0]], 0.2, starts, n_transient=0, n_keep=1)
