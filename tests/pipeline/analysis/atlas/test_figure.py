"""The figure and the GeoJSON of an atlas, on a made-up plane of two regions."""

import json

import numpy as np
import pytest
import shapely
import xarray as xr
from matplotlib.colors import to_hex
from shapely.geometry import shape

from pipeline.analysis.atlas.dataset import WHATS
from pipeline.analysis.atlas.figure import plot_atlas
from pipeline.analysis.atlas.shapes import pieces_of
from pipeline.analysis.branches.kinds import CURVE_KINDS
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import KINDS as SETS
from pipeline.plots import style
from pipeline.runs.exporting import save
from pipeline.specification.problems import SpecError
from tests.pipeline.plots.made_up import DUFFING

SQUARE = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, 0.0)]
HOLE = [(0.5, 0.5), (0.5, 1.5), (1.5, 1.5), (1.5, 0.5), (0.5, 0.5)]


def made_up(labels=("1", "1 + 2"), thin=(0, 1), whats=("fold", "not_decided", "lives_on")):
    """A square plane of side 2 with a square hole, which is the other region; a fold from -0.1 to 2.1 at y = 0.25."""
    x = np.array([-0.1, 0.5, 1.0, 1.5, 2.1])
    n, codes = len(whats), np.array([WHATS.index(one) for one in whats], np.int8)
    rings = [SQUARE, HOLE, HOLE[::-1]]
    corners = np.array([corner for ring in rings for corner in ring])
    variables = {
        "kind": ("curve", np.array([CURVE_KINDS.index("fold")], np.int8), code_flags(CURVE_KINDS)),
        "orbit_period": ("curve", np.array([1])),
        "n_points": ("curve", np.array([5])),
        "first": (("curve", "point"), x[None]),
        "second": (("curve", "point"), np.full((1, 5), 0.25)),
        "others_unstable": (("curve", "point"), np.array([[0, 0, 0, 1, 1]])),
        "n_effects": ("curve", np.array([1])),
        "effect": ("curve", np.array([""], object)),
        "special_kind": ("special", np.array([0, 0], np.int8), code_flags(["cusp"])),
        "special_first": ("special", np.array([1.0, 2.05])),
        "special_second": ("special", np.array([0.25, 0.25])),
        "line_what": ("line", np.array([WHATS.index("boundary_crisis")], np.int8), code_flags(WHATS)),
        "line_period": ("line", np.array([0])),
        "line_size": ("line", np.array([2])),
        "line_first": (("line", "vertex"), np.array([[0.1, 0.2, np.nan]])),
        "line_second": (("line", "vertex"), np.array([[1.5, 1.7, np.nan]])),
        "what": ("change", codes, code_flags(WHATS)),
        "change_set": ("change", np.ones(n, np.int8), code_flags(SETS)),
        "change_attractor": ("change", np.arange(n)),
        "change_period": ("change", np.ones(n, np.int32)),
        "on_curve": ("change", np.array([0] + [-1] * (n - 1))),
        "on_line": ("change", np.full(n, -1)),
        "change_first": ("change", np.linspace(0.3, 0.7, n)),
        "change_second": ("change", np.full(n, 1.8)),
        "why": ("change", np.array(["tried"] * n, object)),
        "area": ("region", np.array([0.75, 0.25])),
        "region_points": ("region", np.array([300, 10])),
        "region_cells": ("region", np.array([3000, 100])),
        "is_thin": ("region", np.array(thin, np.int8)),
        "region_label": ("region", np.array(labels, object)),
        "label_first": ("region", np.array([0.25, 1.0])),
        "label_second": ("region", np.array([1.0, 1.0])),
        "of_region": ("member", np.array([0, 1, 1])),
        "member_attractor": ("member", np.array([0, 0, 1])),
        "member_set": ("member", np.ones(3, np.int8), code_flags(SETS)),
        "member_period": ("member", np.array([1, 1, 2])),
        "member_share": ("member", np.array([1.0, 0.6, 0.4])),
        "member_share_low": ("member", np.array([0.9, 0.5, 0.3])),
        "member_share_high": ("member", np.array([1.0, 0.7, 0.5])),
        "ring_region": ("ring", np.array([0, 0, 1])),
        "ring_size": ("ring", np.array([5, 5, 5])),
        "is_hole": ("ring", np.array([0, 1, 0])),
        "corner_first": ("corner", corners[:, 0], {"units": "N m"}),
        "corner_second": ("corner", corners[:, 1], {"units": "1"}),
    }
    attrs = {**DUFFING, "first_parameter": "amplitude", "second_parameter": "damping", "derived_product": "atlas"}
    return xr.Dataset(variables, attrs=attrs)


def drawn(fig):
    """What is drawn, by id: the number of points of lines, the colours of patches."""
    (ax,) = fig.panels
    lines = {f"{line.get_gid()}": len(line.get_xdata()) for line in ax.lines if line.get_gid()}
    patches = {patch.get_gid(): to_hex(patch.get_facecolor()) for patch in ax.patches if patch.get_gid()}
    return lines, patches, {text.get_gid(): text.get_text() for text in ax.texts if text.get_gid()}


def legend_of(fig):
    return [text.get_text() for text in fig.legends[0].get_texts()]


def test_plot_atlas__what_is_drawn():
    fig = plot_atlas(made_up())
    (ax,) = fig.panels
    assert (ax.get_xlim(), ax.get_ylim()) == ((0.0, 2.0), (0.0, 2.0))
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("amplitude [N m]", "damping")
    lines, patches, names = drawn(fig)
    assert list(patches) == ["region:0", "region:1", "thin:1"]
    assert patches["region:0"] == to_hex(style.tinted(style.PALETTE[0], 0.55))
    assert names == {"label:0": "1", "label:1": "1 + 2"}
    assert lines == {"curve:0": 3, "line:0": 2, "not_explained": 1, "not_found": 1}
    assert [text.get_text() for text in ax.texts if not text.get_gid()] == ["CP"]
    assert legend_of(fig) == [
        *("1, 75.0\u00a0%", "1 + 2, 25.0\u00a0%", "fewer than 299 cells", "LP fold, period 1"),
        *("pale: unstable on both sides", "boundary crisis, on no curve", "not explained: 1", "stable, not found: 1"),
    ]
    told = ax.get_title(loc="left").replace("\n", " ")
    assert told.startswith("periods of the coexisting attractors; 3 changes: 1 on curves, 1 not found, 1 not explained")


def test_plot_atlas__other_results_look_otherwise():
    fig = plot_atlas(made_up(("1", "1"), (1, 1), ("fold", "goes_on")))
    lines, patches, _ = drawn(fig)
    assert lines == {"curve:0": 3, "line:0": 2}
    assert patches["region:0"] == patches["region:1"]
    assert "thin:1" not in patches
    told = fig.panels[0].get_title(loc="left").replace("\n", " ")
    assert "1 change: 1 on curves, fewer than 299 cells in each region" in told
    assert legend_of(fig)[0] == "1, 100.0\u00a0%"
    grey = drawn(plot_atlas(made_up(("none", "not seen"))))[1]
    assert grey["region:0"] == to_hex("0.8")
    assert grey["region:1"] == "#ffffff"


def test_plot_atlas__labels_stay_in_their_regions_and_the_window():
    for width in (178, 170, 85):
        fig = plot_atlas(made_up((" + ".join(["chaotic set"] * 20), "2")), frame=style.Frame(width))
        assert drawn(fig)[2] == {"label:1": "2"}
    fig = plot_atlas(made_up(), frame=style.Frame(xlim=(0.0, 0.4)))
    assert drawn(fig)[2] == {"label:0": "1"}


def test_pieces_of__curves_end_at_the_plane_and_are_cut_where_stability_changes():
    solid, pale = pieces_of(made_up())
    assert (solid.is_stable, pale.is_stable) == (True, False)
    np.testing.assert_allclose(solid.places, [(0.0, 0.25), (0.5, 0.25), (1.0, 0.25)])
    np.testing.assert_allclose(pale.places, [(1.0, 0.25), (1.5, 0.25), (2.0, 0.25)])


def test_geojson__shapes_are_those_of_the_atlas(tmp_path):
    path = save(made_up(), tmp_path / "plane.geojson")
    found = json.loads(path.read_text())
    assert found["properties"]["coordinates"] == [
        {"name": "amplitude", "unit": "N m"},
        {"name": "damping", "unit": "1"},
    ]
    assert found["properties"]["changes"]["not_explained"] == 1
    by_what = {}
    for one in found["features"]:
        assert one["type"] == "Feature"
        geometry = shape(one["geometry"])
        assert geometry.is_valid
        by_what.setdefault(one["properties"]["what"], []).append((geometry, one["properties"]))
    assert {what: len(own) for what, own in by_what.items()} == {"region": 2, "curve": 2, "line": 1, "not explained": 1}
    (outer, about), (inner, _) = by_what["region"]
    assert (outer.area, inner.area) == (pytest.approx(3.0), pytest.approx(1.0))
    assert shapely.is_ccw(outer.exterior)
    assert not shapely.is_ccw(outer.interiors[0])
    assert outer.disjoint(shapely.Point(1.0, 1.0))
    assert about["attractors"] == [{"id": 0, "kind": SETS[1], "period": 1, "share": 1.0, "low": 0.9, "high": 1.0}]
    assert [properties["stable"] for _, properties in by_what["curve"]] == [True, False]
    assert sum(geometry.length for geometry, _ in by_what["curve"]) == pytest.approx(2.0)
    assert by_what["not explained"][0][1]["why"] == "tried"
    with pytest.raises(SpecError, match="only an atlas"):
        save(made_up().assign_attrs(derived_product="curves"), tmp_path / "curves.geojson")
