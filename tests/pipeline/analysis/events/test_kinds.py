"""Kinds of events, each in one place: a new one is seen in the table, the sentence and the figure at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from pipeline.analysis.events import analysis
from pipeline.analysis.events.dataset import dataset_of
from pipeline.analysis.events.figure import plot_genealogy
from pipeline.analysis.events.kinds import EVENTS, EventKind, detectors_of
from pipeline.analysis.events.lines import Fate
from pipeline.analysis.events.scene import Event, Scene
from pipeline.analysis.events.sentences import events_table
from pipeline.layout.vocabulary import ATTRACTS, BOUNDED, CHAOTIC_SET, DIVERGED, PERIODIC_ORBIT
from pipeline.results.ragged import N_IDS, N_POINTS, ROW_SIZE
from tests.pipeline.plots.made_up import DUFFING, legend_texts

ALONG = (0.1, 0.2, 0.3, 0.4)
"""Values of the amplitude: a chaotic set lives up to 0.2, beyond which its cells diverge; an orbit lives throughout."""


def scene() -> Scene:
    ids, status = np.array([[0, 1]] * 4), np.full((4, 2), BOUNDED)
    ids[2:, 0], status[2:, 0] = -1, DIVERGED
    over, per_row = ("amplitude", "start"), [1, 1, 1, 1, 1, 1]
    variables = {
        "attractor": ("set", [0, 1, 0, 1, 1, 1]),
        "kind": ("set", [CHAOTIC_SET, PERIODIC_ORBIT] * 2 + [PERIODIC_ORBIT] * 2),
        "orbit_period": ("set", [0, 3, 0, 3, 3, 3]),
        "stability": ("set", [ATTRACTS] * 6),
        "section": (("sample", "state"), np.zeros((6, 2))),
        N_POINTS: ("set", per_row),
        ROW_SIZE: ("amplitude", [2, 2, 1, 1]),
        "attractor_id": (over, ids),
        "status": (over, status),
        "decision": (over, np.zeros((4, 2), np.int8)),
    }
    found = xr.Dataset(variables, {"amplitude": list(ALONG)}, {**DUFFING, N_IDS: 2})
    located = xr.Dataset(attrs={**DUFFING, "parameter": "amplitude", "parameter_units": "m"})
    base = load_model("duffing").load("twin-well")
    return Scene(found, located, "amplitude", base, np.arange(4), 3.0, [])


def events_of(one: Scene) -> xr.Dataset:
    """Return the events of a scene without branches; those of sets that do not close come last."""
    stretches = analysis._stretches(one)
    one = replace(one, names={(place, s.attractor): s.attractor for s in stretches for place in analysis._places(s)})
    named = [analysis._event(one, s, rises, Fate(np.nan)) for s in stretches for rises in (False, True)]
    assert {end.what for end in named} == {"not_decided", "range_end"}
    return dataset_of(one, stretches, [analysis._aperiodic(one, end, named) for end in named])


def name_blowout(scene: Scene, one: Event, named: list[Event]) -> Event:
    fate = replace(one.fate, value=0.25, why="its transverse exponent is 0")
    return replace(one, fate=fate, what="blowout", error=1e-3)


@pytest.fixture
def blowout(monkeypatch):
    """Let an event kind of the test's own be the one that names ends of chaotic sets."""
    for name, kind in EVENTS.items():
        monkeypatch.setitem(EVENTS, name, replace(kind, ends=()))
    sentence = "blow-out, it repels across its plane"
    kind = EventKind(
        "blowout", "blow-out", "v", sentence, "BO", ends=("chaotic_set",), detector=f"{__name__}:name_blowout"
    )
    monkeypatch.setitem(EVENTS, kind.name, kind)
    return kind


def test_new_kind__is_in_the_table_the_sentence_and_the_figure(blowout):
    ds = events_of(scene())
    table = events_table(ds)
    (row,) = (row for row in table.rows if row["what"] not in ("range_end",))
    assert (row["what"], row["label"], row["amplitude"], row["amplitude_error"]) == ("blowout", "BO", 0.25, 1e-3)
    assert row["evidence"] == "its transverse exponent is 0"
    sentence = "A (chaotic set) ends at amplitude = 0.250 ± 1e-03 m as it rises: blow-out, it repels across its plane"
    assert row["sentence"] == f"{sentence}; its cells diverge"
    assert f"  {row['sentence']}" in table.lines
    assert table.lines[0] == "1 event, 0 not decided"
    figure = plot_genealogy(ds).figure
    assert "BO blow-out" in legend_texts(figure)
    (ax,) = figure.axes
    assert "BO" in [text.get_text() for text in ax.texts]
    assert "v" in [line.get_marker() for line in ax.lines if list(line.get_xdata()) == [0.25]]


def test_without_a_detector__the_end_is_open(blowout, monkeypatch):
    monkeypatch.setitem(EVENTS, "blowout", replace(blowout, ends=("torus",)))
    ds = events_of(scene())
    table = events_table(ds)
    (row,) = (row for row in table.rows if row["what"] == "not_decided")
    assert "ends between amplitude = 0.2 and 0.3 m as it rises: not decided" in row["sentence"]
    assert "not decided" in legend_texts(plot_genealogy(ds).figure)


def test_detectors__are_there_and_each_is_tried_once():
    for ends in ("torus", "chaotic_set", "periodic_orbit"):
        found = detectors_of(ends)
        assert len(found) == len(set(found)) > 0
        assert all(callable(analysis.resolve_name(place)) for place in found)
    assert detectors_of("torus")[0].endswith("cascades:name_torus")
    assert detectors_of("chaotic_set")[-1].endswith("crises:name_crisis")  # the dearest comes last


@pytest.mark.parametrize("name", [n for n, kind in EVENTS.items() if kind.marker])
def test_sentence__of_each_kind_names_it(name):
    row = {"criticality": "supercritical", "set": "periodic_orbit", "period": 2, "is_own": 1, "branch": 4}
    row |= {"other_branch": 5, "ratio": 4.67, "exponent": 0.5, "exponent_error": 0.02, "rotation": "1/3"}
    row |= {"met_period": 3, "twin": -1, "lives_beyond": 0, "doublings": [3.0, 3.45]}
    kind = EVENTS[name]
    sentence = kind.told(row)
    assert not kind.label or f"({kind.label})" in sentence
    first = kind.text.removeprefix("lost into a ").removeprefix("it ").split()[0]
    assert first in sentence or name == "locking"


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, "supercritical period doubling (PD), onto the orbit of period 4 (branch 5)"),
        ({"criticality": "subcritical"}, "subcritical period doubling (PD), it meets the unstable orbit of period 4"),
        ({"criticality": "unknown"}, "period doubling (PD)"),
        ({"criticality": "unknown", "is_own": 0}, "period doubling (PD), it shrinks onto the orbit of period 1"),
    ],
)
def test_sentence__of_a_doubling_by_its_degree_and_its_branch(changed, words):
    row = {"criticality": "supercritical", "set": "periodic_orbit", "period": 2, "is_own": 1, "other_branch": 5}
    told = EVENTS["period_doubling"].told(row | changed)
    assert told.startswith(words)
    assert len(told) == len(words) or "branch" in told
