"""The drive's rate as omega and as period, from the specification to tables and figures."""

from __future__ import annotations

import re
from math import pi

import numpy as np
import pytest
import xarray as xr
from matplotlib.text import Text
from scipy.integrate import solve_ivp

import magpend
from pipeline.analysis.branches.declaration import BranchOptions, CurveOptions
from pipeline.analysis.branches.kinds import KINDS as BIFURCATIONS
from pipeline.analysis.events.cascades import cascade_of
from pipeline.analysis.events.crises import _law
from pipeline.analysis.events.lines import Fate
from pipeline.analysis.events.transients import Lifetimes
from pipeline.compute.simulate import simulate
from pipeline.layout.cells import parameter_axes
from pipeline.layout.own_words import in_own_words, place_in_words, rate_attribute, width_in_own_words
from pipeline.products.product import StateOptions
from pipeline.results.sets import Geometry
from pipeline.runs.naming import named
from pipeline.specification.problems import SpecError
from pipeline.specification.tables import RATES

pytestmark = pytest.mark.usefixtures("long_steps_of_a_file")

SPRING = "x'' = F*cos(omega*t) - 0.1*x' - x - x**3\nF = 0.3"


def spring(text=SPRING):
    spec = magpend.Spec("sweep", text).with_start_random(n=2, x=(-3.0, 3.0), x_dot=(-3.0, 3.0), seed=1)
    return spec.with_integration(n_transient=200, n_keep=2)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Runs along omega, period and frequency that have the same cells."""
    folder, omega = tmp_path_factory.mktemp("rates"), np.linspace(1.2, 1.9, 8)
    values = {"omega": omega, "period": 2 * pi / omega[::-1], "frequency_hz": omega / (2 * pi)}
    return {
        word: magpend.run(spring().with_axis(word, values=own), folder / word, workers=0, echo=lambda _: None)
        for word, own in values.items()
    }


def test_cells__have_frequencies(runs):
    for run in runs.values():
        np.testing.assert_allclose(run.cube().frequency, np.linspace(1.2, 1.9, 8) / (2 * pi), rtol=1e-15)
        assert run.cube().frequency.attrs["units"] == "Hz"
    same = [run.cube()["section"].values for run in (runs["omega"], runs["frequency_hz"])]
    np.testing.assert_array_equal(*same)


@pytest.mark.slow
def test_tables__have_the_word_of_the_specification(runs):
    """Located folds and jumps: values converted, directions of a period turned round."""
    hertz, omega, period = (
        runs[word].branches(max_period=1).magpend.table() for word in ("frequency_hz", "omega", "period")
    )
    folds = hertz["frequency_hz"].values
    assert len(folds) == 2
    np.testing.assert_allclose(omega["omega"], 2 * pi * folds, rtol=1e-7)
    np.testing.assert_allclose(np.sort(period["drive_period"]), np.sort(1 / folds), rtol=1e-7)
    rises = {word: in_own_words(runs[word].response())["jump_rises"].values.tolist() for word in runs}
    assert rises["omega"] == rises["frequency_hz"] == [1 - turned for turned in rises["period"]]


@pytest.mark.parametrize("word", RATES)
def test_widths__are_scaled_by_the_derivative(word):
    rate, width = RATES[word], 1e-6
    assert rate.slope(0.2) * width == pytest.approx(abs(rate.given(0.2 + width) - rate.given(0.2)), rel=1e-5)


def test_place_in_words__has_the_word_of_the_specification():
    """Values of the frequency alone, in the order given, or as a range from the lower to the higher one."""
    assert place_in_words("frequency", "omega", 0.25, 0.5, digits=10) == "omega = 1.570796327, 3.141592654"
    assert place_in_words("frequency_hz", "period", 0.2, 0.25, between=" to ") == "drive_period = 4 to 5"
    assert place_in_words("frequency", "frequency_hz", 0.2, 0.25) == "frequency_hz = 0.2, 0.25"
    assert place_in_words("frequency", "omega", 0.9 / (2 * pi)) == "omega = 0.9"
    assert place_in_words("F", "omega", 3.0) == "F = 3"
    assert width_in_own_words("frequency", "omega", 0.2, 1e-3) == pytest.approx(2 * pi * 1e-3)
    assert width_in_own_words("frequency", "period", 0.2, 1e-3) == pytest.approx(25e-3)
    assert width_in_own_words("F", "period", 0.2, 1e-3) == 1e-3


def located(word):
    """Doublings along the drive's frequency, in the words of a specification."""
    values = np.array([0.2, 0.25, 0.2618])
    doublings = np.full(3, BIFURCATIONS.index("period_doubling"))
    names = {"value": values, "kind": doublings, "of_branch": [0, 1, 2], "to_branch": [1, 2, 3]}
    names |= {"n_unstable_before": [0, 0, 0], "n_unstable_after": [1, 1, 1]}
    attrs = {"parameter": "frequency", **rate_attribute(word)}
    return xr.Dataset({name: ("bifurcation", value) for name, value in names.items()}, attrs=attrs)


@pytest.mark.parametrize(
    ("word", "values", "limit"),
    [
        ("frequency_hz", "frequency_hz = 0.2, 0.25, 0.2618", "frequency_hz = 0.265"),
        ("omega", "omega = 1.256637061, 1.570796327, 1.644937913", "omega = 1.665"),
        ("period", "drive_period = 5, 4, 3.819709702", "drive_period = 3.773"),
    ],
)
def test_evidence__has_the_word_of_the_specification(word, values, limit):
    geometry = Geometry((False,), (1.0,))
    found = cascade_of(located(word), Fate(0.2, bifurcation=0), (0.2, 0.21), np.zeros((3, 1)), geometry)
    assert found.why.startswith(f"doublings at {values}, last ratio 4.2373, limit at {limit}")
    times = Lifetimes((0.3,), (12.0,), 0.5, 0.01, 0.25, 1e-3, (0.5, 0.01))
    law = _law(located(word), times, 0.5, 0.01)
    width = {"frequency_hz": "1e-03", "omega": "6e-03", "period": "2e-02"}[word]
    own = RATES[word].column
    assert law.startswith(f"mean lifetimes 12 at {own} = ")
    assert law.endswith(f" of the distance from {own} = {RATES[word].given(0.25):.10g} ± {width}")


def test_start__has_the_rate_in_any_of_its_words(runs):
    state = {"x": 0.5, "x_dot": 0.0}
    for run in runs.values():
        for word, value in (("omega", 1.5), ("period", 2 * pi / 1.5), ("frequency_hz", 1.5 / (2 * pi))):
            for parameter in ("", "omega", "frequency_hz"):
                found = named(run, BranchOptions(parameter=parameter, start={**state, word: value})).start
                assert found == pytest.approx({**state, "frequency_hz": 1.5 / (2 * pi)})
    problems = {
        "omega": (1.95, r"start: omega = 1\.95 is outside of 1\.2 to 1\.9; change low= and high=\."),
        "period": (0.0, r"start: period = 0 must be greater than 0\."),
        "omgea": (1.5, r"start: unknown state 'omgea'; did you mean omega\?"),
    }
    for word, (value, message) in problems.items():
        with pytest.raises(SpecError, match=message):
            runs["omega"].branches(start={**state, word: value})
    with pytest.raises(SpecError, match=r"omega and period are both frequency_hz; leave one of them out\."):
        runs["omega"].branches(start={**state, "omega": 1.5, "period": 4.0})
    for given in ({"at": {"period": 0.0}}, {"parameter": "period", "low": 0.0}):
        with pytest.raises(SpecError, match=r"^period = 0 must be greater than 0\."):
            named(runs["omega"], StateOptions(**given) if "at" in given else BranchOptions(**given))


@pytest.mark.slow
def test_left_out__has_the_word_of_the_specification(runs):
    found = runs["omega"].branches(parameter="omega", low=1.25, high=1.35, start={"x": 1e9, "x_dot": 0.0, "omega": 1.3})
    lines = found.attrs["left_out"].splitlines()
    assert lines[0] == "start at omega = 1.3: Newton's method found no orbit of period 1 from there"
    outside = [line for line in lines if line.startswith("attractor")]
    assert outside
    for line in outside:
        assert re.search(
            r" at omega = 1\.\d( to 1\.\d)?( \(\d points\))?: outside of omega = 1\.25 to 1\.35; widen", line
        )


@pytest.mark.slow
def test_options__take_values_in_the_word_that_they_name(runs):
    part = runs["frequency_hz"].branches(parameter="omega", low=1.3, high=1.5, max_period=1)
    assert (part.attrs["parameter"], len(part["bifurcation_frequency"])) == ("frequency", 1)
    np.testing.assert_allclose(part["frequency"].max(), 1.5 / (2 * pi), rtol=1e-12)
    own = runs["period"].branches(low=2 * pi / 1.5, high=2 * pi / 1.3, max_period=1)  # of the only axis, so in its word
    np.testing.assert_allclose(own["bifurcation_frequency"], part["bifurcation_frequency"], rtol=1e-7)
    cell = runs["frequency_hz"].cube().magpend.sel_cell(omega=1.3)
    np.testing.assert_allclose(float(cell.frequency), 1.3 / (2 * pi), rtol=1e-15)


def test_options__second_parameter_has_the_unit_of_its_own_name(tmp_path):
    spec = spring().with_parameters(omega=1.3).with_axis("F", 0.1, 0.3, 2)
    run = magpend.run(spec, tmp_path / "run", workers=0, echo=lambda _: None)
    ranges = {"frequency_hz": (0.1, 0.3), "omega": (0.2 * pi, 0.6 * pi), "period": (1.0 / 0.3, 10.0)}
    for word, bounds in ranges.items():
        found = named(run, CurveOptions(second=word, second_low=bounds[0], second_high=bounds[1]))
        assert (found.parameter, found.second) == ("F", "frequency_hz")
        assert (found.second_low, found.second_high) == pytest.approx((0.1, 0.3), rel=1e-12)


@pytest.mark.slow
def test_figures__are_labelled_as_the_user_wrote(runs):
    for word, label in (("omega", r"$\omega$"), ("period", "drive period")):
        runs[word].branches(max_period=1)
        upper, _ = runs[word].plot.response()
        low, high = upper.get_xlim()
        wanted = (1.2, 1.9) if word == "omega" else (2 * pi / 1.9, 2 * pi / 1.2)
        assert low < wanted[0] < wanted[1] < high < 1.2 * wanted[1]
        texts = [text.get_text() for text in upper.figure.findobj(Text)]
        assert label in texts
        assert not any("Hz" in text or "frequency" in text for text in texts)
    ax = runs["omega"].plot.bifurcation()
    assert ax.get_xlabel() == r"angular drive frequency $\omega$"


def test_specification__keeps_the_word(tmp_path):
    spec = spring().with_axis("omega", 0.5, 2.0, 4)
    again = magpend.Spec.parse(spec.as_dict())
    assert (again, again.rate, again.tables["axes"]) == (
        spec,
        "omega",
        {"omega": {"start": 0.5, "stop": 2.0, "num": 4}},
    )
    (axis,) = parameter_axes(spec)
    np.testing.assert_array_equal(axis.values, np.array([0.5, 1.0, 1.5, 2.0]) / (2 * pi))
    assert spring().with_parameters(period=4.0).with_axis("F", 0.1, 0.2, 2).frequency_hz == 0.25
    walk = magpend.Spec.parse({**spec.as_dict(), "kind": "continuation", "continuation": {"path": "omega"}})
    assert walk.as_dict()["continuation"]["path"] == "omega"
    assert magpend.Spec.parse(walk.as_dict()) == walk


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"parameters": {"omega": 1.0, "period": 2.0}}, "parameters.omega and parameters.period: all give the rate"),
        ({"parameters": {"omega": 1.0}, "axes": {"period": {"values": [1.0]}}}, "axes.period and parameters.omega"),
        ({"axes": {"omega": {"values": [-1.0, 1.0]}}}, "axes.omega: its least value -1.0 must be greater than 0 rad/s"),
        ({"parameters": {"omega": -1.0}}, "parameters.omega"),
        ({"axes": {"omega": {"start": 1.0}}}, "axes.omega: give start, stop and num"),
        ({}, "parameters.frequency_hz: missing; set it there (or omega, or period)"),
        (
            {"kind": "continuation", "axes": {"period": {"values": [1.0, 2.0]}}},
            "continuation.path = 'period': branches follow frequency_hz or omega",
        ),
    ],
)
def test_specification__says_what_is_wrong_with_a_rate(change, words):
    with pytest.raises(magpend.SpecError) as caught:
        magpend.Spec.parse({**spring().tables, **change})
    assert words in str(caught.value)


FLOW = {"name": "free", "states": {"x": "1", "y": "1"}, "equations": {"x": "y", "y": "-x"}}
SECTION = {"of": "x", "value": 0.0, "direction": "up"}


@pytest.mark.parametrize("word", ["omega", "period"])
def test_specification__of_a_system_without_a_drive(word):
    """A rate beside a section by crossing is refused like a frequency; without one it is that of even times."""
    tables = {"kind": "sweep", "model": FLOW, "initial_conditions": {"kind": "list", "points": [[1.0, 0.0]]}}
    for rate in ({"parameters": {word: 2.0}}, {"axes": {word: {"values": [1.0, 2.0]}}}):
        with pytest.raises(magpend.SpecError, match=rf"{next(iter(rate))}\.{word}: a section by crossing needs no"):
            magpend.Spec.parse({**tables, **rate, "section": SECTION})
    even = magpend.Spec.parse({**tables, "parameters": {word: 2.0}})
    assert even.frequency_hz == (1.0 / pi if word == "omega" else 0.5)


def test_omega__of_a_text_is_the_drives():
    """The name omega in a text that uses time is 2 pi f: scipy's trajectory at this angular frequency."""
    ds = simulate(None, [1.0, 0.5], model=magpend.model(SPRING), overrides={"omega": 1.3}, n_periods=4, rtol=1e-11)
    own = solve_ivp(
        lambda t, y: [y[1], 0.3 * np.cos(1.3 * t) - 0.1 * y[1] - y[0] - y[0] ** 3],
        (0.0, 8.0 * pi / 1.3),
        [1.0, 0.5],
        rtol=1e-11,
        atol=1e-11,
    )
    np.testing.assert_allclose(float(ds["x"][-1]), own.y[0, -1], rtol=1e-7)


def test_omega__of_a_model_stays_its_parameter():
    """A text that gives omega a value, or does not use time, has its own."""
    free = magpend.model("x'' = A*cos(2*pi*f*t) - omega**2*x", omega=1.5, A=0.1)
    assert set(free.parameter_names) == {"omega", "A"}
    spec = spring(free).with_axis("omega", 1.0, 2.0, 3).with_parameters(period=4.0)
    assert [(a.dim, *a.values) for a in parameter_axes(spec)] == [("omega", 1.0, 1.5, 2.0)]
    with pytest.raises(magpend.SpecError, match="unknown name 'omega'"):
        magpend.model("x'' = -omega**2*x")


def test_zoom_and_extension__take_the_word(runs):
    closer = runs["omega"].zoom({"omega": (1.3, 1.5)}, num=5)
    assert closer.tables["axes"]["omega"] == {"start": 1.3, "stop": 1.5, "num": 5}
    other = runs["omega"].zoom({"period": (4.5, 5.0)}, num=3)
    assert list(other.as_dict()["axes"]) == ["period"]
