"""Sentences on an atlas, on the made-up plane of the figure's tests."""

import numpy as np

from pipeline.analysis.atlas.sentences import sentences
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import KINDS, PERIODIC_ORBIT
from tests.pipeline.analysis.atlas.test_figure import made_up


def bordered(**given):
    """The made-up plane of orbits, with a border between its regions on its curve, and one on its first line."""
    ds = made_up(**given)
    return ds.assign(
        change_set=("change", np.full(ds.sizes["change"], PERIODIC_ORBIT, np.int8), code_flags(KINDS)),
        member_set=("member", np.full(3, PERIODIC_ORBIT, np.int8), code_flags(KINDS)),
        between=("border", np.array([0, 1])),
        neighbour=(("border", "side"), np.array([[0, 1], [0, 1]])),
        border_length=("border", np.array([1.0, 0.5])),
    )


def test_sentences__all_that_the_plane_contains():
    assert sentences(bordered()) == [
        "The plane of amplitude (0 to 2 N m) and damping (0 to 2) has 2 regions, 1 curve of bifurcations and 1 line "
        "of other ends of attractors.",
        "Region 0 covers 75 % of the plane, with 300 parameter points and 3000 cells. Met there: 1 attractor (fraction "
        "of these cells and its 95 % interval): A, periodic orbit of period 1: 1.000 (0.900 to 1.000).",
        "Region 1 covers 25 % of the plane, with 10 parameter points and 100 cells. Met there: 2 attractors (fraction "
        "of these cells and its 95 % interval): A, periodic orbit of period 1: 0.600 (0.500 to 0.700); "
        "B, periodic orbit of period 2: 0.400 (0.300 to 0.500).",
        "What parts regions: 0 and 1 by curve 0 (fold, period 1), line 0 (boundary crisis).",
        "The cells show 3 changes of attractors between neighbouring parameter points: 1 on curves and 0 on lines "
        "(1 fold); 1 of orbits that are stable at both points, where no cell of one point finds them; 1 left without "
        "an explanation.",
        "Not explained: B, periodic orbit of period 1, at amplitude 0.5, damping 1.8. Tried.",
        "Fewer than 299 cells are known in region 1: an attractor with a basin of 1 % may be missing there.",
    ]


def test_sentences__nothing_met_and_nothing_changed():
    ds = bordered(thin=(1, 1), whats=("goes_on",))
    ds = ds.assign(
        area=("region", np.array([0.999, 0.001])),
        region_points=("region", np.array([0, 1])),
        of_region=("member", np.array([1, 1, 1])),
        n_effects=("curve", np.array([0])),
        effect=("curve", np.array(["its orbits are unstable on both sides"], object)),
    )
    assert sentences(ds)[1:] == [
        "Region 0 covers 99.9 % of the plane, with no parameter point. Met there: no attractor.",
        "1 smaller region (0.1 % of the plane) is not described here.",
        "No attractor differs between neighbouring parameter points.",
        "1 of 1 curve change no attractor: curve 0, its orbits are unstable on both sides.",
        "Fewer than 299 cells are known in any region: an attractor with a basin of 1 % may be missing there.",
    ]


def test_sentences__many_unexplained_changes_are_counted():
    told = sentences(bordered(whats=("not_decided",) * 20))
    assert sum(text.startswith("Not explained: ") for text in told) == 12
    assert "8 more changes without an explanation: see the table of the analysis." in told
