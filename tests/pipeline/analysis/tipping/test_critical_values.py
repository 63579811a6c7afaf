"""Critical values, final parameters and numbers of attractors of runs whose parameters move, without integration."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from pipeline.analysis.tipping.analysis import (
    Bisection,
    Bracket,
    _attractors_of,
    _brackets,
    _cells,
    _of_brackets,
    brackets_of,
    needs_drift,
    outcome_word,
    tipping_table,
)
from pipeline.analysis.tipping.declaration import TippingOptions
from pipeline.analysis.tipping.endings import UNKNOWN_END, Final, Group, ends_s, finals_of
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import KINDS
from pipeline.results.outcomes import DIVERGED
from pipeline.specification.spec import Spec
from tests.core.flows import model_of
from tests.pipeline.factories import FOLD, FOLD_LENGTH

RATES = FOLD["axes"]["l_rate_per_s"]["values"]


def run_of(**changes: object) -> SimpleNamespace:
    """Return as much of a run of the moving fold as critical values ask for."""
    spec = Spec.parse({**FOLD, **changes})
    status = (("l_rate_per_s", "initial_condition"), np.zeros((4, 2), np.int8))
    return SimpleNamespace(spec=spec, cube=lambda: xr.Dataset({"status": status}))


@pytest.mark.parametrize(
    ("outcomes", "pairs"),
    [
        ([0, 0, 1, 1], [(1, 2)]),
        ([0, UNKNOWN_END, UNKNOWN_END, 1], [(0, 3)]),  # what is not decided lies inside
        ([0, UNKNOWN_END, 0], []),
        ([UNKNOWN_END, 1, DIVERGED, 1], [(1, 2), (2, 3)]),
        ([UNKNOWN_END, UNKNOWN_END], []),
    ],
)
def test_brackets_of__neighbouring_outcomes_that_are_known(outcomes, pairs) -> None:
    assert brackets_of(np.array(outcomes)) == pairs


def test_bracket__keeps_the_half_at_whose_ends_outcomes_differ() -> None:
    whole = Bracket(0, (), 1.0, 2.0, 3, 7)
    assert (whole.halved(3).low, whole.halved(3).high, whole.halved(3).outcome_high) == (1.5, 2.0, 7)
    assert (whole.halved(7).low, whole.halved(7).high) == (1.0, 1.5)
    third = whole.halved(5)  # a third attractor: the lower change is kept, with its own name
    assert (third.low, third.high, third.outcome_low, third.outcome_high) == (1.0, 1.5, 3, 5)
    unknown = whole.halved(UNKNOWN_END)
    assert not unknown.is_decided
    assert (unknown.low, unknown.high, unknown.n_evaluated) == (1.0, 2.0, 1)


class ByRule(Bisection):
    """A bisection whose trajectories follow a rule instead of the engine."""

    def __init__(self, rule, options: TippingOptions) -> None:
        super().__init__(run_of(), "l_rate_per_s", (), {}, options)
        self.rule = rule

    def _outcomes(self, brackets: list[Bracket]) -> np.ndarray:
        return np.array([self.rule(b) for b in brackets])


def test_bisection__finds_the_square_root_of_two() -> None:
    bisection = ByRule(lambda b: 0 if b.middle**2 < 2.0 else 1, TippingOptions(interval=1e-9))
    (found,) = bisection.run_all([Bracket(0, (), 1.0, 2.0, 0, 1)])
    # the width is a part of the axis' range, from .9 to 1.3
    assert found.high - found.low <= 4e-10
    assert found.low < np.sqrt(2.0) < found.high
    assert found.n_evaluated == 32  # 2^-31 > 4e-10 > 2^-32
    assert found.is_decided


def test_bisection__ends_each_bracket_by_itself() -> None:
    def rule(bracket: Bracket) -> int:
        return UNKNOWN_END if bracket.start == 1 else int(bracket.middle > 1.25)

    brackets = [Bracket(k, (), 1.0, 2.0, 0, 1) for k in range(3)]
    found = ByRule(rule, TippingOptions(interval=0.01)).run_all(brackets)
    assert [b.is_decided for b in found] == [True, False, True]
    assert [b.n_evaluated for b in found] == [8, 1, 8]
    assert found[0].low <= 1.25 <= found[0].high


def test_bisection__stops_at_neighbouring_numbers() -> None:
    low = 1.0
    high = np.nextafter(low, 2.0)
    (found,) = ByRule(lambda b: 0, TippingOptions(interval=1e-300)).run_all([Bracket(0, (), low, high, 0, 1)])
    assert (found.low, found.high, found.n_evaluated) == (low, high, 0)


def test_brackets__of_each_start_along_the_axis() -> None:
    outcome = np.array([[0, 0], [0, DIVERGED], [UNKNOWN_END, DIVERGED], [DIVERGED, DIVERGED]])
    found = _brackets(run_of(), "l_rate_per_s", (), outcome, ("l_rate_per_s",))
    assert [(b.start, b.low, b.high, b.outcome_low, b.outcome_high) for b in found] == [
        (0, 1.0, 1.3, 0, DIVERGED),
        (1, 0.9, 1.0, 0, DIVERGED),
    ]


def test_brackets__stay_at_their_values_of_other_axes() -> None:
    axes = {"l_rate_per_s": {"values": [0.9, 1.1]}, "l_to": {"values": [5.0, 10.0, 20.0]}}
    run = run_of(axes=axes, drift={"l": {"from": 0.0}})
    outcome = np.zeros((2, 3, 1), int)
    outcome[1, 2] = 1
    (found,) = _brackets(run, "l_rate_per_s", ("l_to",), outcome, ("l_rate_per_s", "l_to"))
    assert (found.point, found.low, found.high) == ((20.0,), 0.9, 1.1)
    along = _brackets(run, "l_to", ("l_rate_per_s",), outcome, ("l_rate_per_s", "l_to"))
    assert [(b.point, b.low, b.high) for b in along] == [((1.1,), 10.0, 20.0)]


def test_finals_of__all_rates_end_at_one_value() -> None:
    run = run_of()
    packed, frequency, _ = _cells(run)
    finals = finals_of(run.spec, packed, frequency)
    assert len(finals) == 8
    assert len({final.key for final in finals}) == 1
    assert dict(finals[0].parameters) == {"l": FOLD_LENGTH}
    assert finals[0].frequency_hz == 1.0
    # the ramp of length 20 ends after 20/rate, for both starts
    np.testing.assert_allclose(ends_s(run.spec, packed, frequency), np.repeat(FOLD_LENGTH / np.array(RATES), 2))


def test_finals_of__different_ends_are_different_points() -> None:
    drift = {"l": {"rate_per_s": 1.0, "start_s": 3.0}}
    run = run_of(drift=drift, axes={"l_to": {"values": [5.0, 10.0]}})
    packed, frequency, _ = _cells(run)
    finals = finals_of(run.spec, packed, frequency)
    assert [final.parameters["l"] for final in finals] == [5.0, 5.0, 10.0, 10.0]
    assert len({final.key for final in finals}) == 2
    np.testing.assert_allclose(ends_s(run.spec, packed, frequency), [8.0, 8.0, 13.0, 13.0])


def test_needs_drift__refuses_runs_that_end_on_the_way() -> None:
    needs_drift(run_of(), TippingOptions(parameter="l_rate_per_s"))
    short = run_of(integration={**FOLD["integration"], "n_keep": 20})
    with pytest.raises(ValueError, match="ends after 20 periods, while its parameters move until period 23"):
        needs_drift(short, TippingOptions(parameter="l_rate_per_s"))
    with pytest.raises(ValueError, match="l_to is not an axis of this run; its axes: l_rate_per_s"):
        needs_drift(run_of(), TippingOptions(parameter="l_to"))


def group_of(a: float, cells: list[int], outcome: list[int], points: list[float]) -> Group:
    """Return a group with equilibria at given points; the cells that diverged were not integrated on."""
    n = len(points)
    ids = xr.Dataset(
        {
            "kind": ("attractor", np.full(n, KINDS.index("equilibrium"), np.int8), code_flags(KINDS)),
            "orbit_period": ("attractor", np.ones(n, np.int32)),
            "attractor_points": (("attractor", "sample", "state"), np.reshape(points, (n, 1, 1))),
        }
    )
    final = Final(model_of({"x": "a - x"}, {"a": 0.0}).load(a=a), 1.0)
    went_on = np.array([c for c, o in zip(cells, outcome, strict=True) if o != DIVERGED])
    return Group(final, np.array(cells), ids, went_on, np.zeros((len(went_on), 1)), np.array(outcome))


@pytest.fixture
def attractors() -> xr.Dataset:
    """Return the table of attractors of two groups; of the first group an attractor has no cell."""
    groups = [
        group_of(1.0, [0, 1, 2], [2, 0, 2], [-1.0, 0.5, 1.0]),
        group_of(2.0, [3, 4, 5], [0, DIVERGED, UNKNOWN_END], [3.0]),
    ]
    return xr.Dataset(_attractors_of(groups))


def test_attractors__of_all_groups_that_have_cells(attractors) -> None:
    table = attractors
    assert table["attractor_point"].values.tolist() == [[-1.0], [1.0], [3.0]]
    assert table["attractor_n_cells"].values.tolist() == [1, 2, 1]
    assert table["attractor_group"].values.tolist() == [0, 0, 1]
    assert table["attractor_kind"].values.tolist() == ["equilibrium"] * 3
    # what distinguishes the groups, and nothing else
    assert table["final_parameters"].values.tolist() == ["a = 1", "a = 2"]


def test_tipping_table__names_outcomes_and_counts_cells(attractors) -> None:
    outcome = xr.DataArray([[1, 0, 1], [2, DIVERGED, UNKNOWN_END]], dims=("a", "initial_condition"))
    brackets = [Bracket(1, (), 1.25, 1.250002, 0, DIVERGED, 19), Bracket(2, (), 1.0, 2.0, 1, 2, 1, is_decided=False)]
    ds = attractors.assign(
        outcome=outcome, course=xr.zeros_like(outcome), **_of_brackets(brackets, (), load_model("duffing"))
    )
    ds = ds.assign_coords(a=("a", [1.0, 2.0], {"units": "N"})).assign_attrs(parameter="a", n_brackets=3)
    table = tipping_table(ds)
    assert [(row["from"], row["to"], row["decided"]) for row in table.rows] == [
        ("A", "diverged", True),
        ("B", "C", False),
    ]
    assert table.rows[0]["value"] == pytest.approx(1.250001, rel=1e-12)
    text = "\n".join(table.lines)
    assert "1.250001 ± 1e-06" in text
    assert "3 critical values of a; the first 2 are bisected (--brackets)" in text
    assert "a trajectory inside is not decided" in text
    counts = table.lines[table.lines.index("cells on each") :][:4]
    assert counts[1].split() == ["a", "N", "A", "B", "C", "diverged", "not", "decided"]
    assert [line.split() for line in counts[2:]] == [["1", "1", "2", "0", "0", "0"], ["2", "0", "0", "1", "1", "1"]]


def test_tipping_table__joins_values_with_equal_counts() -> None:
    table = _attractors_of([group_of(1.0, [0, 1, 2, 3], [0, 0, 0, 0], [-1.0])])
    outcome = xr.DataArray([[0], [0], [0], [DIVERGED]], dims=("rate", "initial_condition"))
    ds = xr.Dataset(table).assign(
        outcome=outcome, course=xr.ones_like(outcome), **_of_brackets([], (), load_model("duffing"))
    )
    ds = ds.assign_coords(rate=[0.1, 0.2, 0.3, 0.4]).assign_attrs(parameter="rate", n_brackets=0)
    lines = tipping_table(ds).lines
    assert any(line.split() == ["0.1", "to", "0.3", "1", "0"] for line in lines)
    assert lines[-1] == "no cell changes its attractor along the sweep"


def test_outcome_word__letters_and_what_is_no_attractor() -> None:
    assert [outcome_word(o) for o in (0, 25, 26, DIVERGED, UNKNOWN_END)] == ["A", "Z", "AA", "diverged", "not decided"]
