"""Branches and curves of a run: what is asked for, what is refused, what is left out, what is said."""

import numpy as np
import pytest

from pipeline.analysis.attractors.analysis import attractors_table
from pipeline.analysis.branches.declaration import BranchOptions
from pipeline.analysis.branches.kinds import KINDS
from pipeline.analysis.branches.orbit_search import orbits_table
from pipeline.cli.console import Exit
from pipeline.layout.vocabulary import ABSENT, CHAOTIC_SET
from pipeline.products.registry import ANALYSES, FIGURES
from pipeline.products.reporting import reporting
from pipeline.results.ragged import dense
from pipeline.runs.derive import AnalysedRun, derive, prepared, shown_table
from pipeline.specification.problems import SpecError
from tests.pipeline.analysis.cubes import sweep
from tests.pipeline.analysis.dense_sets import rows_of

SPEC = sweep(
    "duffing",
    [[1.2, 0.0], [-1.2, 0.0]],
    axes={"amplitude": {"values": [0.25, 0.275, 0.289, 0.5]}},
    parameters={"preset": "twin-well", "overrides": {"damping": 0.3}},
    frequency_hz=0.1909859317,
    lengths=(300, 200),
)
ALONG = {"parameter": "amplitude", "low": 0.24, "high": 0.3}
SHORT = {**ALONG, "max_period": 2}


@pytest.fixture(scope="module")
def directory(computed):
    """A run over the cascade of a twin-well oscillator: periods 1, 2, 4 and chaos."""
    return computed(SPEC)


@pytest.mark.slow
def test_attractors__ids_through_the_cascade(directory):
    """The orbits of each well have one id, from period 1 to 4; the chaos beyond has another one."""
    ds = dense(derive(directory, "attractors"), points=True)
    periods = ds["orbit_period"].values.T.tolist()
    assert sorted(periods)[1:] == [[1, 2, 0, 0], [1, 2, 4, 0]]
    basis = ds["match_basis"].values
    words = ds["match_basis"].attrs["flag_meanings"].split()
    assert {words[b] for b in basis[1:3, :2].ravel()} == {"doubling", "absent"}
    assert ds["kind"].values[3].tolist() == [ABSENT, ABSENT, CHAOTIC_SET]
    text = "\n".join(attractors_table(rows_of(ds)).lines)
    assert "id by" in text
    assert "first appearance" in text


@pytest.mark.slow
def test_branches__all_periods_or_a_line(directory):
    heard = []
    with reporting(lambda what, done, total, *_: heard.append((what, done, total))):
        ds = derive(directory, "branches", ALONG)
    assert sorted(set(ds["orbit_period"].values.tolist())) == [1, 2, 4]
    assert any("following branches" in what and 0 < done <= total for what, done, total in heard)
    told = shown_table("branches", ds)
    assert {(row["label"], row["type"]) for row in told.rows} >= {("PD", "period_doubling")}
    lines = told.lines
    assert any("does not close" in line and "--recurrences" in line for line in lines)
    short = derive(directory, "branches", SHORT)
    left_out = [line for line in shown_table("branches", short).lines if "take it with --period 4" in line]
    assert len(left_out) == 1
    assert "amplitude = 0.289" in left_out[0]
    # a stored result says it again
    again = derive(directory, "branches", SHORT)
    assert shown_table("branches", again).lines == shown_table("branches", short).lines


def test_branches__none_to_begin_with(directory, main, tmp_path):
    ds = derive(directory, "branches", {"parameter": "amplitude", "low": 0.4, "high": 0.6})
    assert ds.sizes["branch"] == 0
    lines = shown_table("branches", ds).lines
    assert lines[0].startswith("no branch")
    assert any("outside of amplitude = 0.4 to 0.6" in line for line in lines)
    # With the reason, and without a file
    words = ("--parameter", "amplitude", "--from", 0.4, "--to", 0.6)
    code, out, err = main("analyse", "branches", directory, *words, "--csv", "found.csv")
    assert code == Exit.REFUSED
    assert out == ""
    assert "no branch along amplitude: there is no closed orbit to begin with" in err
    assert "2 of 3: outside of amplitude = 0.4 to 0.6" in err
    assert "1 of 3: a set that does not close" in err
    assert not (tmp_path / "found.csv").exists()


@pytest.mark.slow
def test_branches__along_the_frequency_by_either_name(directory):
    """Of a run that does not sweep it."""
    options = {"low": 0.18, "high": 0.2, "max_period": 1, "generations": 0}
    one = derive(directory, "branches", {"parameter": "frequency", **options})
    other = derive(directory, "branches", {"parameter": "frequency_hz", **options})
    assert one.attrs["derived_key"] == other.attrs["derived_key"]
    assert one.attrs["parameter"] == "frequency"
    assert one.attrs["parameter_units"] == "Hz"
    # the branches begin at other amplitudes, and say so
    assert set(np.round(one["amplitude"].values, 3)) == {0.25}
    for row in shown_table("branches", one).rows:
        assert [name for name in row if "frequency" in name] == ["frequency_hz"]
        assert row["amplitude"] == 0.25


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parameter": "amplitud"}, "did you mean amplitude"),
        ({"parameter": "damping"}, "give the interval with --from and --to"),
        ({"parameter": "amplitude", "low": 0.3, "high": 0.2}, "must be less than --to"),
        ({"parameter": "frequency", "low": -1.0, "high": 1.0}, "greater than 0"),
        ({"max_period": -1}, "max_period"),
    ],
)
def test_branches__refusals(directory, options, message):
    with pytest.raises(SpecError, match=message):
        derive(directory, "branches", options)


@pytest.mark.slow
def test_curves__in_the_plane_of_amplitude_and_damping(directory):
    """Both wells' first doublings: two curves over each other, by the mirror symmetry."""
    derive(directory, "branches", {"max_period": 1, **ALONG})
    plane = {"parameter": "amplitude", "second": "damping", "second_low": 0.25, "second_high": 0.4}
    ds = derive(directory, "curves", plane)
    assert ds.sizes["curve"] == 2
    assert set(ds["kind"].values) == {KINDS.index("period_doubling")}
    assert set(ds["orbit_period"].values) == {1}
    highest = np.nanmax(ds["damping"].values, axis=1)
    assert highest[0] == pytest.approx(highest[1], rel=0.05)
    assert sum("period_doubling, period 1" in line for line in shown_table("curves", ds).lines) == 2
    assert ds["damping"].attrs["units"] == "1/s"
    with pytest.raises(SpecError, match="did you mean damping"):
        derive(directory, "curves", {**plane, "second": "dampin"})
    with pytest.raises(SpecError, match="own parameter"):
        derive(directory, "curves", {**plane, "second": "amplitude"})


@pytest.mark.slow
def test_branches__from_recurrences_in_chaos(directory):
    """Unstable orbits inside of the chaos, where no closed orbit attracts."""
    options = {"parameter": "amplitude", "low": 0.45, "high": 0.55, "recurrences": 2, "generations": 0}
    ds = derive(directory, "branches", options)
    assert ds.sizes["branch"] >= 2
    assert (ds["n_unstable"].values[:, 0] > 0).any()
    assert float(ds["residual"].max()) < 1e-9


@pytest.mark.parametrize("interval", [{"low": 0.24, "high": 0.3}, {"low": 0.26}, {"high": 0.28}, {"generations": 3}])
def test_branches__by_default_along_what_the_run_sweeps(directory, interval):
    """Whether the interval is given or not; the frequency is followed where it is asked for."""
    run = AnalysedRun.of(directory)
    settled = prepared(run, ANALYSES["branches"], BranchOptions(**interval))
    assert settled.parameter == "amplitude"
    assert (settled.low, settled.high) == (interval.get("low", 0.25), interval.get("high", 0.5))
    asked = BranchOptions(parameter="frequency", low=0.18, high=0.2)
    assert prepared(run, ANALYSES["branches"], asked).parameter == "frequency_hz"
    drawn = prepared(run, FIGURES["branches"], FIGURES["branches"].options())
    assert drawn.parameter == "amplitude"
    assert drawn.label() == "_x_parameter_amplitude"
    along = FIGURES["branches"].options(parameter="frequency")
    assert prepared(run, FIGURES["branches"], along).label() == "_x"


@pytest.mark.parametrize("interval", [{}, {"low": 2.1, "high": 2.4}])
def test_branches__of_several_axes_say_which(made, interval):
    """Two axes are swept, and none is named: one sentence with both, before anything is computed."""
    made.commit(0)
    with pytest.raises(SpecError) as refused:
        derive(made.info.directory, "branches", interval)
    (sentence,) = refused.value.problems
    assert "run sweeps frequency_hz, q; say which of them to follow: " in sentence
    assert "--parameter=frequency_hz or --parameter=q" in sentence
    assert not (made.info.directory / "derived").exists()


@pytest.mark.slow
def test_orbits__at_a_point(directory):
    """All orbits of period 1 by their index, both wells' among them."""
    ds = derive(directory, "orbits", {"at": {"amplitude": 0.25}, "max_period": 1, "starts": 100})
    table = orbits_table(ds)
    assert int(ds["index_sum"][0]) == 1
    assert sorted(row["index"] for row in table.rows) == [-1, 1, 1]
    assert any("add up to 1" in line for line in table.lines)
    with pytest.raises(SpecError, match="choose a value of each, such as --at amplitude"):
        derive(directory, "orbits", {"max_period": 1})
