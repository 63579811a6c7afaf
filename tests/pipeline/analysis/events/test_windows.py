"""Events in windows of neighbouring parameter values, against those along the whole axis and closed forms."""

from __future__ import annotations

import numpy as np
import pytest

import magpend
from pipeline.analysis.events.windows import events_within
from pipeline.layout.vocabulary import parameters_of
from pipeline.results.ragged import isel
from pipeline.results.selection import choose, start_dims
from pipeline.results.tabular import words_of
from pipeline.runs.derive import AnalysedRun

LOGISTIC = magpend.model("x' = r*x*(1 - x/K)", name="logistic", kind="map", r=3.2, K=1.0)
"""K is the unit of x: bifurcations by r do not depend on it."""
ALONG = (3.4, 3.5, 3.56, 3.5713, 3.66, 3.69, 3.82, 3.83)
MERGING = float(np.roots([1.0, -2.0, -4.0, -8.0])[0].real)
"""Two bands merge where the third iterate of the middle is the fixed point."""

KNOWN = {"cascade": (3.56, 3.569945672), "band_merging": (3.66, MERGING), "intermittency_i": (3.82, 1.0 + np.sqrt(8.0))}
"""First of the two values of a window, and where its chaotic set begins, changes or ends."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    spec = magpend.Spec("sweep", LOGISTIC).with_axis("K", values=[1.0, 2.0]).with_axis("r", values=list(ALONG))
    spec = spec.with_start_random(n=4, seed=0, x=(0.1, 0.9)).with_integration(n_transient=2000, n_keep=200)
    folder = tmp_path_factory.mktemp("windows") / "run"
    magpend.run(spec, folder, workers=0)
    return AnalysedRun.of(folder)


def within(run, K, first, n=2, between=None):
    """Return the decided ends in a window of the row at K."""
    found, k = run.derive("attractors"), ALONG.index(first)
    part = choose(found, {"K": K}, ("r", *start_dims(found)), "a row of the plane")
    part = isel(part, {"r": slice(k, k + n)})
    return decided(events_within(part, "r", parameters_of(run.cube()), (ALONG[0], ALONG[-1]), between=between))


def decided(ds):
    """Return the value and the error of each decided end by its kind, the last value before it and the one beyond."""
    what = np.array(words_of(ds["what"]))[ds["what"].values].tolist()
    names = ("seen", "beyond", "value", "value_error")
    rows = zip(what, *(ds[name].values.tolist() for name in names), strict=True)
    return {one[:3]: one[3:] for one in rows if one[0] not in ("range_end", "not_decided")}


@pytest.mark.parametrize(("what", "K"), [("cascade", 2.0), ("band_merging", 1.0), ("intermittency_i", 2.0)])
def test_events_within__ends_of_chaotic_sets(run, what, K):
    first, known = KNOWN[what]
    ((value, error),) = (end for (name, *_), end in within(run, K, first).items() if name == what)
    assert abs(value - known) <= error < 1e-6


def test_events_within__orbits_alone(run):
    """The period 4 doubles; ends of the window are no events."""
    found = within(run, 1.0, 3.5)
    assert set(found) == {("period_doubling", 3.5, 3.56), ("period_doubling", 3.56, 3.5)}
    assert all(abs(value - 3.544090359) <= error + 1e-9 < 1e-8 for value, error in found.values())


def test_events_within__decides_between_two_values_alone(run):
    found = within(run, 1.0, 3.69, 3, between=(3.82, 3.83))
    assert set(found) == {("intermittency_i", 3.82, 3.83), ("fold", 3.83, 3.82)}
    assert set(within(run, 1.0, 3.69, 3, between=(3.69, 3.82))) == {("fold", 3.83, 3.82)}


@pytest.mark.slow
def test_events_within__equals_the_whole_axis(run):
    """A window has branches of longer orbits, so that its limit of a cascade errs less."""
    whole = decided(run.derive("events", parameter="r", at={"K": 1.0}))
    assert {"period_doubling", "fold", *KNOWN} <= {name for name, *_ in whole}
    for what, (first, _) in KNOWN.items():
        found = within(run, 1.0, first)
        assert what in {name for name, *_ in found}
        for key, (value, error) in found.items():
            assert abs(value - whole[key][0]) <= error + whole[key][1]
