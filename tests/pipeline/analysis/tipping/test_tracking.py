"""Tracking, returning and tipping: ways of parameters, courses and their diagram, without integration."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magpend_core.models.drift.ramps import TABLE, Ramp, motions_of
from pipeline.analysis.tipping.analysis import Bracket, _of_brackets, tipping_table
from pipeline.analysis.tipping.declaration import COURSES
from pipeline.analysis.tipping.diagram import plot_tipping
from pipeline.analysis.tipping.tracking import Ends, course_of, waypoints
from pipeline.layout.conventions import code_flags
from pipeline.layout.vocabulary import model_attribute
from pipeline.results.outcomes import DIVERGED
from tests.core.flows import model_of
from tests.pipeline.analysis.tipping.test_critical_values import group_of


def test_course_of__by_both_motions() -> None:
    stays = np.array([1, 1, 0, 0, -1, 1, 0])
    away = np.array([1, 0, 0, 1, 1, -1, -1])
    names = [COURSES[k] for k in course_of(stays, away)]
    assert names[:4] == ["tracking", "returning", "tipping", "return_tipping"]
    # what ends elsewhere has tipped, whatever is known of the way
    assert names[4:] == ["not_decided", "not_decided", "tipping"]


def motions(*ramps: Ramp, **values: float):
    """Return the motions of one cell whose drive has a period of 1 s."""
    numbers = {name: value for ramp in ramps for name, (_, value) in zip(ramp.names, ramp.numbers, strict=True)}
    own = {**values, **numbers}
    return motions_of(ramps, tuple(own), np.array([[*own.values()]]), np.array([1.0]))


@pytest.mark.parametrize("shape", ["linear", "tanh"])
@pytest.mark.parametrize("duration", [0.3, 700.0])
def test_waypoints__have_equal_steps_whatever_the_rate(shape, duration) -> None:
    way = waypoints(motions(Ramp("a", shape, (("to", 3.0), ("duration_s", duration))), a=1.0), 0, 4)
    assert way.tolist() == [[1.0], [1.5], [2.0], [2.5], [3.0]]


def test_waypoints__there_and_back_and_of_two_parameters() -> None:
    back = Ramp("a", "linear", (("to", -1.0), ("duration_s", 2.0), ("hold_s", 50.0)))
    assert waypoints(motions(back, a=1.0), 0, 4).ravel().tolist() == [1.0, 0.0, -1.0, 0.0, 1.0]
    # b goes while a waits at its second value
    other = Ramp("b", "linear", (("to", 8.0), ("duration_s", 10.0), ("start_s", 5.0)))
    way = waypoints(motions(back, other, a=1.0, b=0.0), 0, 3)
    np.testing.assert_allclose(way, [[1.0, 0.0], [-1.0, 0.0], [-1.0, 8.0], [1.0, 8.0]], atol=1e-8)
    table = Ramp("a", TABLE, (), (0.0, 1.0, 9.0), (0.0, 2.0, 1.0))
    np.testing.assert_allclose(waypoints(motions(table, a=0.0), 0, 3).ravel(), [0.0, 1.0, 2.0, 1.0], atol=1e-8)


def test_ends__number_attractors_over_all_groups() -> None:
    ends = Ends.of([group_of(1.0, [0, 1, 2], [2, 0, 2], [-1.0, 0.5, 1.0]), group_of(2.0, [3, 4], [0, DIVERGED], [3.0])])
    assert ends.outcome.tolist() == [1, 0, 1, 2, DIVERGED]
    assert [labels.tolist() for _, _, labels in ends.known.values()] == [[0, 1, 1], [2]]
    assert ends.state(2).tolist() == [0.0]


@pytest.fixture
def swept() -> xr.Dataset:
    """Return courses over rates, sizes and two starts, with a critical value of each start."""
    model = model_of({"x": "a - x"}, {"a": 0.0})
    course = np.array([[[1, 1, 2], [1, 3, 3]], [[0, 1, 1], [4, 1, 1]]], np.int8)  # start, size, rate
    brackets = [Bracket(0, (5.0,), 0.12, 0.14, 0, DIVERGED, 9), Bracket(1, (5.0,), 0.1, 0.2, DIVERGED, 0, 9)]
    dims = ("initial_condition", "size", "rate")
    table = {f"attractor_{k}": ("attractor", np.zeros(0, int)) for k in ("kind", "period", "n_cells", "group")}
    table |= {"attractor_point": (("attractor", "state"), np.zeros((0, 1))), "final_parameters": ("group", [""])}
    critical = _of_brackets(brackets, ("a",), model)
    critical["critical_at_size"] = critical.pop("critical_at_a")
    return xr.Dataset(
        {**table, **critical, "course": (dims, course, code_flags(COURSES)), "outcome": (dims, np.zeros_like(course))},
        coords={"rate": [0.1, 0.2, 0.3], "size": [4.0, 5.0]},
        attrs={"model": model_attribute(model), "parameter": "rate", "n_brackets": 2},
    )


def test_tipping_table__counts_courses(swept) -> None:
    lines = tipping_table(swept).lines
    first = lines.index("cells by what becomes of their first attractor")
    assert lines[first + 1].split() == [
        *("rate", "tracking", "returning", "tipping"),
        *("return", "tipping", "not", "decided"),
    ]
    assert [line.split() for line in lines[first + 2 : first + 5]] == [
        ["0.1", "2", "0", "0", "1", "1"],
        ["0.2", "3", "0", "1", "0", "0"],
        ["0.3", "2", "1", "1", "0", "0"],
    ]


def drawn(figure, gid):
    """Return the artist with an id."""
    return next(artist for artist in figure.axes[0].get_children() if artist.get_gid() == gid)


def test_plot_tipping__maps_one_start_over_two_numbers(swept) -> None:
    figure = plot_tipping(swept, start=0)
    assert drawn(figure, "courses").get_array().reshape(2, 3).tolist() == [[1, 1, 2], [1, 3, 3]]
    # upright borders: 4 | at .25 of the first row, .15 of the second
    segments = np.array(drawn(figure, "borders").get_segments())
    np.testing.assert_allclose(segments[:, :, 0], [[0.25, 0.25], [0.15, 0.15]])
    np.testing.assert_allclose(segments[:, :, 1], [[3.5, 4.5], [4.5, 5.5]])
    np.testing.assert_allclose(drawn(figure, "critical").get_xydata(), [[0.13, 5.0]])
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    assert names == ["tracking", "returning", "tipping", "critical value"]
    names = [text.get_text() for text in plot_tipping(swept, start=1).legends[0].get_texts()]
    assert names == ["tracking", "return tipping", "not decided", "critical value"]
    with pytest.raises(ValueError, match="start = 2: the run has the initial conditions 0 to 1"):
        plot_tipping(swept, start=2)


def test_plot_tipping__bands_of_all_starts_over_one_number(swept) -> None:
    figure = plot_tipping(swept, at={"size": 5.0})
    assert drawn(figure, "courses").get_array().reshape(2, 3).tolist() == [[1, 3, 3], [4, 1, 1]]
    np.testing.assert_allclose(drawn(figure, "critical").get_xydata(), [[0.13, 0], [0.15, 1]])
    assert not drawn(plot_tipping(swept, at={"size": 4.0}), "critical").get_xydata().size
    with pytest.raises(ValueError, match="at most one other; left are third, size, rate"):
        plot_tipping(swept.expand_dims(third=[1.0, 2.0]))
    with pytest.raises(ValueError, match="left are none"):
        plot_tipping(swept, at={"size": 4.0, "rate": 0.1})
