"""From options to files: names, values between those of an axis, provenance, sizes."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex

from magpend_core.models import load_model
from pipeline.plots import Frame, draw_figure, save_data, save_figure
from pipeline.plots.bifurcation import plot_bifurcation
from pipeline.plots.figure import _metadata
from pipeline.plots.palette import motions_of
from pipeline.plots.style import GREY, PALETTE
from pipeline.products.product import Options, default_of
from pipeline.products.registry import FIGURES
from pipeline.results.selection import place
from tests.pipeline.plots.made_up import PENDULUM


def make_cube(n=5, n_keep=3):
    """Cells of two starts over the frequency."""
    size = 0.1 + 0.01 * np.arange(n)[:, None] + 0.001 * np.arange(n_keep)
    section = np.stack([np.stack([size, size, 10 * size, -size], -1)] * 2, axis=1)
    return xr.Dataset(
        {
            "section": (("frequency", "initial_condition", "period_index", "state"), section),
            "status": (("frequency", "initial_condition"), np.full((n, 2), 2, np.int8)),
            "turns": (("frequency", "initial_condition", "link"), np.zeros((n, 2, 2), np.int32)),
        },
        coords={
            "frequency": ("frequency", 2.0 + 0.05 * np.arange(n), {"units": "Hz"}),
            "state": ["psi1", "psi2", "psi1_dot", "psi2_dot"],
        },
        attrs={**PENDULUM, "source": "magpend 9, kernel abc"},
    )


class FakeRun:
    """What figures use of a run."""

    digest = "c" * 64
    info = SimpleNamespace(
        title="a run",
        digest="d" * 64,
        versions={"numpy": "9.9"},
        provenance={"host": "node7", "created": "2026-01-02T03:04:05+00:00", "git_commit": "f" * 40},
    )

    def __init__(self):
        self.said, self.derived = [], []
        self.echo = self.said.append

    def cube(self, chunks=None):
        return make_cube()

    def derive(self, name, **options):
        self.derived.append(name)
        raise AssertionError("computed before the options were looked at")


def options_of(name, **given):
    return FIGURES[name].options.model_validate(given)


def other_value(model, name):
    """A valid value of an option that is not its default."""
    default = default_of(model, name)
    if isinstance(default, dict) and name == "within":
        return {"psi1": (-1.0, 1.0)}
    if isinstance(default, dict) and name != "at":
        return {"psi1": 0.5}
    special = {
        "at": {"frequency": 2.05},
        "xlim": (2.0, 2.1),
        "ylim": (0.0, 1.0),
        "layout": "side",
        "per": "period",
        "show": "number",
        "colour": "attractor",
        "width": 85.0,
        "dpi": 300.0,
        "state": "psi2",
        "quantity": "energy.max",
        "against": "psi2",
        "second_low": 0.5,
        "second_high": 0.7,
        "over": "other/run",
        "parameter": "q",
        "low": 2.0,
        "drive_low": 0.1,
        "drive_high": 0.2,
        "high": 2.5,
        "shown": 2,
        "between": ("A", "C"),
        "radius": 0.5,
        "cell": 3,
        "bins": 50,
    }
    if name in special:
        return special[name]
    if isinstance(default, bool):
        return not default
    return default + 1 if isinstance(default, int) else 0.123 if isinstance(default, float) else "other"


@pytest.mark.parametrize("name", list(FIGURES))
def test_label__every_option_that_changes_the_picture_changes_the_name(name):
    model = FIGURES[name].options
    assert issubclass(model, Options)
    assert {"at", "nearest", "degrees", "width", "xlim", "ylim"} <= set(model.model_fields)
    required = {
        key: {"second": "q", "between": ("A", "B")}.get(key, 1.0)
        for key, field in model.model_fields.items()
        if field.is_required()
    }
    base = model.model_construct(**required)
    seen = {base.label(): "nothing"}
    for key in model.model_fields:
        label = model.model_construct(**{**required, key: other_value(model, key)}).label()
        assert label not in seen, f"{key} and {seen.get(label)} give the same file name {label!r}"
        seen[label] = key


def test_label__tells_close_values_apart_and_has_what_was_given():
    labels = {options_of("gallery", at={"frequency": f}).label() for f in (2.2, 2.2000001, 2.2000002)}
    assert len(labels) == 3
    assert "_frequency_2.2" in labels
    # a quantity replaces the state
    assert options_of("bifurcation", state="psi1", quantity="energy.max").label() == "_energy.max"
    assert options_of("branches", over=r"C:\runs\line").label() == "_over_C--runs-line"  # a name on Windows, too


def test_place__value_of_the_axis_or_its_neighbours():
    assert [place(make_cube()["frequency"], value) for value in (2.05, 2.05 + 4e-8)] == [1, 1]
    with pytest.raises(ValueError, match=r"2\.053 is not on its axis; the nearest values are 2\.05 and 2\.1"):
        place(make_cube()["frequency"], 2.053)
    with pytest.raises(ValueError, match=r"lies off its axis, which runs from 2 to 2\.2"):
        place(make_cube()["frequency"], 3.0)


@pytest.mark.parametrize("name", ["gallery", "basins", "section", "dimension", "fractions"])
def test_draw_figure__value_between_is_refused_before_anything_is_computed(name):
    run, state = FakeRun(), {"state": "psi1"} if "state" in FIGURES[name].options.model_fields else {}
    with pytest.raises(ValueError, match=r"nearest values are 2\.05 and 2\.1"):
        draw_figure(run, name, options_of(name, at={"frequency": 2.053}, **state))
    assert run.derived == []


def test_draw_figure__nearest_is_said_and_shown():
    run = FakeRun()
    given = options_of("section", state="psi1", at={"frequency": 2.053}, nearest=True)
    figure = draw_figure(run, "section", given)
    assert run.said == ["frequency_hz = 2.053 is not on its axis; drawn at the nearest, 2.05"]
    assert figure.axes[0].get_title(loc="left") == "$f$ = 2.05\N{NO-BREAK SPACE}Hz"
    assert float(figure.data["frequency"]) == 2.05


@pytest.mark.slow
def test_draw_figure__provenance_beside_and_inside(tmp_path):
    figure = draw_figure(FakeRun(), "bifurcation", options_of("bifurcation", state="psi2", width=85.0))
    path = save_data(figure, save_figure(figure, tmp_path / "a.png"))
    with xr.open_dataset(path, engine="scipy") as stored:
        attrs = stored.attrs
        assert stored["y"].attrs["units"] == "rad"
        assert stored["y"].size == 30
    assert attrs["figure"] == "bifurcation"
    assert json.loads(attrs["options"]) == {"state": "psi2", "width": 85.0}
    assert attrs["digest"] == "d" * 64
    assert attrs["cube_digest"] == "c" * 64
    assert json.loads(attrs["versions"]) == {"numpy": "9.9"}
    assert (attrs["host"], attrs["git_commit"]) == ("node7", "f" * 40)
    assert attrs["created"].startswith("2026-01-02")
    assert attrs["model"] == "pendulum"
    for suffix in (".png", ".svg"):
        written = save_figure(figure, tmp_path / f"a{suffix}").read_bytes()
        assert all(text in written for text in (b"node7", b"d" * 64, b"bifurcation diagram"))


def test_metadata__have_no_characters_that_are_no_xml():
    """A forged version of magpend, with escapes for a terminal, made an SVG that nothing could read."""
    found = _metadata({"title": "a\x1b[31m\x00b", "source": "magpend \x1b[2J\ud800", "host": "n\x07"}, ".svg")
    assert (found["Title"], found["Source"]) == ("a[31mb", "magpend [2J")
    assert found["Description"].endswith("host: n")


@pytest.mark.slow
def test_files__without_what_is_empty_and_with_fonts_as_outlines(tmp_path):
    """A dim of length 0 is NetCDF's for one that may grow; scipy does not read it back."""
    figure = plot_bifurcation(make_cube())
    # type 42 embeds TrueType outlines; type 3 would be drawings without a name that journals take
    written = save_figure(figure, tmp_path / "a.pdf").read_bytes()
    assert b"/Type3" not in written
    assert b"/FontFile2" in written
    assert b"drive frequency [Hz]</text>" in save_figure(figure, tmp_path / "a.svg").read_bytes()
    figure.data = xr.Dataset({"none": (("empty", "x"), np.zeros((0, 2))), "some": ("x", [1.0, 2.0])})
    with xr.open_dataset(save_data(figure, tmp_path / "a.png"), engine="scipy") as stored:
        assert stored["some"].values.tolist() == [1.0, 2.0]
        assert set(stored.variables) == {"some"}


@pytest.mark.slow
def test_frame__limits_show_and_keep_a_part():
    figure = plot_bifurcation(make_cube(), frame=Frame(xlim=(2.04, 2.11), ylim=(0.105, 0.125)))
    ax = figure.axes[0]
    assert ax.get_xlim() == (2.04, 2.11)
    assert ax.get_ylim() == (0.105, 0.125)
    assert sorted(set(np.round(figure.data["x"].values, 6))) == [2.05, 2.1]
    with pytest.raises(ValueError, match=r"xlim = 2, 2: must be two different"):
        plot_bifurcation(make_cube(), frame=Frame(xlim=(2.0, 2.0)))
    # fixed values are shown
    cube = xr.concat([make_cube(), make_cube()], xr.DataArray([1.0, 1.5], dims="q", name="q"))
    cube["q"].attrs = {"units": "N m"}
    figure = plot_bifurcation(cube.transpose("frequency", "q", "initial_condition", ...), at={"q": 1.5})
    assert figure.axes[0].get_title(loc="left") == "q = 1.5\N{NO-BREAK SPACE}N m"


def test_motions__words_have_colours_and_neutral_ones_are_grey():
    found = motions_of(make_cube())
    assert found.words == load_model("pendulum").classifier.words
    assert found.colours[found.words.index("left")] == PALETTE[0]
    assert {to_hex(found.colours[c]) for c in load_model("pendulum").classifier.neutral} == {GREY.lower()}
    own = [found.colours[c] for c in found.drawn if found.colours[c] != GREY]
    assert len(set(own)) == len(own)
    assert not motions_of(make_cube().assign_attrs(model="duffing")).told
