"""Margins and errors of eigenvalues; equilibria, degenerate orbits and conservative flows of small texts."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.analysis.attractors.features import Features
from pipeline.analysis.attractors.finding.closed_orbits import Orbit
from pipeline.analysis.attractors.finding.stability import by_margin, largest_error
from pipeline.analysis.attractors.labelling import _fill_orbit
from pipeline.layout.vocabulary import ATTRACTS, NEUTRAL, NOT_SETTLED, PERIODIC_ORBIT, UNSTABLE
from pipeline.results.outcomes import other_cells, outcomes, sentence
from pipeline.results.ragged import dense, isel
from pipeline.runs.derive import derive, stale
from tests.core.flows import table
from tests.pipeline.analysis.cubes import line, sweep


def orbit(multiplier, residual=1e-13):
    return Orbit(np.zeros((1, 1)), np.array([multiplier + 0j]), residual, np.array([[multiplier]]))


def test_stability__by_the_error_of_a_multiplier():
    assert by_margin(0.9, 1.0, 0.05) == ATTRACTS
    assert by_margin(0.97, 1.0, 0.05) == by_margin(1.03, 1.0, 0.05) == NEUTRAL
    assert by_margin(1.1, 1.0, 0.05) == UNSTABLE
    assert largest_error(np.diag([1.0, 0.5]), 1e-10) < 1e-9
    jordan = np.array([[1.0, 1.0], [0.0, 1.0]])
    assert largest_error(jordan, 1e-10) == pytest.approx(1e-5, rel=0.9)
    assert np.isnan(largest_error(np.full((2, 2), np.nan), 1e-10))
    assert orbit(0.999).stability == ATTRACTS
    assert orbit(-1.001).stability == UNSTABLE
    assert orbit(1.0).stability == NEUTRAL
    # beside a fold Newton's method stops where the residual is small, and the multiplier off by its root
    assert orbit(1.0 - 1e-5, residual=1e-10).stability == NEUTRAL
    saddle = replace(orbit(382.0, residual=1e6), approached_within=0.05)
    assert saddle.is_stable
    with pytest.raises(AssertionError, match="a multiplier of modulus 382 is said to attract"):
        _fill_orbit(Features(saddle.points, PERIODIC_ORBIT, 1, np.zeros(0), 0, np.zeros(1), np.zeros(1)), saddle, False)


@pytest.mark.parametrize(("residual", "known"), [(1e-8, NEUTRAL), (1e-4, NOT_SETTLED)])
def test_fill_orbit__a_multiplier_whose_error_covers_everything_decides_nothing(residual, known):
    one = orbit(0.999, residual)
    found = Features(one.points, PERIODIC_ORBIT, 1, np.zeros(0), 0, np.zeros(1), np.zeros(1), stability=one.stability)
    _fill_orbit(found, one, False)
    assert (one.stability, found.stability) == (NEUTRAL, known)


# a pitchfork at r = 0, beside a damped state that the drive moves; from starts on a symmetric grid
SPEC = sweep(
    table("unst", {"x": "r*x - x**3", "y": "-y + cos(2*pi*f*t)"}, {"r": 0.3}),
    {"kind": "grid", "x": line(-1.0, 1.0, 5), "y": 0.0},
    axes={"r": {"values": [0.0, 0.001, 3.0]}},
    frequency_hz=1.0,
    lengths=(300, 60),
)


@pytest.fixture(scope="module")
def pitchfork(computed):
    return computed(SPEC)


@pytest.mark.slow
def test_attractors__a_repeller_on_the_grid_is_none(pitchfork):
    """+-sqrt(r) with the multiplier exp(-2 r), two of five cells each; 0 with exp(r); all cells at r = 0."""
    shown = attractors_table(derive(pitchfork, "attractors"))
    rows = shown.rows
    told = {(row["r"], row["stability"], row["n_cells"], round(row["multiplier_modulus"], 4)) for row in rows}
    assert told == {
        (0.0, "attracts", 5, 1.0),
        (0.001, "attracts", 2, 0.998),
        (0.001, "unstable", 1, 1.001),
        (3.0, "attracts", 2, 0.3679),
        (3.0, "unstable", 1, 20.0855),
    }
    assert [row["evidence"] for row in rows if row["r"] == 0.0] == ["approach"]
    fractions = [row["fraction"] for row in rows if row["r"] > 0.0 and row["stability"] == "attracts"]
    assert fractions == [2 / 5] * 4
    assert all(np.isnan(row["fraction"]) for row in rows if row["stability"] == "unstable")
    sweep = 1.0 / np.hypot(1.0, 2.0 * np.pi)  # amplitude of y' = -y + cos(2 pi t)
    for row in rows[-3:]:
        root = 0.0 if row["stability"] == "unstable" else np.copysign(np.sqrt(3.0), row["section_x"])
        assert [row[f"{part}_x"] for part in ("section", "min", "max")] == pytest.approx([root] * 3, abs=1e-8)
        assert [row["section_y"], row["min_y"], row["max_y"]] == pytest.approx([sweep**2, -sweep, sweep], abs=2e-3)
    text = "\n".join(shown.lines)
    assert "  1.732  " in text
    assert "  0.0247 (-0.1572 to 0.1572)  " in text


@pytest.mark.slow
def test_outcomes_and_basins__of_a_repeller(pitchfork):
    ids = dense(derive(pitchfork, "attractors"), points=True)
    assert (outcomes(ids) == -1).sum() == 2
    assert {name: int(which.sum()) for name, which in other_cells(ids).items()} == {
        "on an unstable orbit or equilibrium": 2
    }
    assert sentence(ids) == "13 of 15 cells end on attractors; 2 on an unstable orbit or equilibrium"
    found = derive(pitchfork, "basins")
    assert found["n_unstable"].values.tolist() == [0, 1, 1]
    at = isel(found, {"r": found["r"].values.tolist().index(3.0)})
    # of all five starts, one of which has no outcome and could change that
    assert at["fraction"].values.tolist() == pytest.approx([0.4, 0.4])
    assert at["fraction_if_all"].values.max() == pytest.approx(0.6)


@pytest.mark.slow
def test_derive__options_of_attractors_hold_everywhere(pitchfork):
    """Other analyses rest on the attractors as they were last sought, and what rested on others is stale."""
    without = derive(pitchfork, "attractors", {"extend": False, "n_points": 8})
    assert without.attrs["identify_extend"] == 0
    assert derive(pitchfork, "basins").attrs["identify_extend"] == 0
    more = derive(pitchfork, "attractors", {"budget": 3.0, "n_points": 8})
    assert derive(pitchfork, "attractors").attrs["derived_key"] == more.attrs["derived_key"]
    assert any("basins" in name for name in stale(pitchfork))
    assert derive(pitchfork, "basins").attrs["identify_budget"] == 3.0
