"""``--smoke`` without a table ``[smoke]`` makes a small run by itself, and `zoom` keeps the table."""

from __future__ import annotations

import pytest

from pipeline.layout.plan import make_plan
from pipeline.runs.zoom import Changes, read_source, write_zoom
from pipeline.specification.spec import Spec


def test_smoke__fewest_points_and_starts(write_spec, sweep_text, walk_text):
    small = Spec.read(write_spec(sweep_text), smoke=True)
    assert [axis.array().tolist() for axis in small.axes.values()] == [[2.0, 3.0], [1.5, 1.6]]
    assert make_plan(small).shape == (2, 2, 2, 2)
    assert small.integration == Spec.read(write_spec(sweep_text)).integration
    walk = Spec.read(write_spec(walk_text), smoke=True)
    assert make_plan(walk).n_cells == 2 * 2 * 2  # frequencies, starts, directions
    rows = sweep_text.replace('kind = "grid"', 'kind = "list"\npoints = [[0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0]]')
    rows = "\n".join(line for line in rows.splitlines() if not line.startswith("psi"))
    assert make_plan(Spec.read(write_spec(rows), smoke=True)).shape == (2, 2, 2)


def test_smoke__a_refined_grid_and_a_fixed_axis(write_spec, sweep_text):
    text = sweep_text.replace('kind = "grid"', 'kind = "grid"\nrefine = 2').replace("[1.5, 1.6]", "[1.5]")
    small = Spec.read(write_spec(text), smoke=True)
    assert small.refine is None
    assert make_plan(small).shape == (2, 1, 2, 2)


def test_smoke__a_specification_that_is_wrong_says_so(write_spec, sweep_text):
    with pytest.raises(ValueError, match=r"axes\.q\.values"):
        Spec.read(write_spec(sweep_text.replace("[1.5, 1.6]", "7")), smoke=True)


def test_zoom__keeps_the_smoke_table(write_spec, sweep_text, tmp_path):
    smoke = "[smoke]\naxes.frequency_hz.num = 3\ninitial_conditions.psi1_deg.num = 2\n"
    source = read_source(write_spec(sweep_text + smoke))
    assert write_zoom(source, Changes({"frequency_hz": (2.2, 2.4)}), tmp_path / "a.toml") == []
    assert make_plan(Spec.read(tmp_path / "a.toml", smoke=True)).shape == (3, 2, 2, 4)
    assert make_plan(Spec.read(tmp_path / "a.toml")).shape == (5, 2, 3, 4)
    notes = write_zoom(source, Changes({"q": (1.5, 1.55)}, {"frequency_hz": 2.2}), tmp_path / "b.toml")
    assert any("[smoke]" in note for note in notes)
    Spec.read(tmp_path / "b.toml", smoke=True)
