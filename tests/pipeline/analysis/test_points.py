"""Measured points: columns in any spelling of the axes, converted to the unit of the cube, and their refusals."""

from __future__ import annotations

import numpy as np
import pytest

import magpend
from magpend_core.models import load_model
from pipeline.analysis.points import read_points
from pipeline.layout.own_words import in_own_words, spelling_of
from pipeline.rig.measured.branch import read_branch
from pipeline.specification.problems import SpecError

TURN = 2.0 * np.pi


def written(folder, text):
    path = folder / "points.csv"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("frequency_hz", [8.0, 16.0]),
        ("frequency", [8.0, 16.0]),
        ("omega", [8.0 * TURN, 16.0 * TURN]),
        ("period", [0.125, 0.0625]),
        ("drive_period", [0.125, 0.0625]),
    ],
)
def test_read_points__takes_the_drive_in_all_its_words(tmp_path, column, values):
    """A run over omega: the figure has the points where it has the curves, at 50.3 and 100.5 rad/s."""
    file = written(tmp_path, f"{column},amplitude,level\n{values[0]!r},1,3\n{values[1]!r},2,3\n")
    found = read_points(file, load_model("duffing"), "frequency", rate="omega")
    np.testing.assert_allclose(found["parameter"], [8.0, 16.0], rtol=1e-15)
    np.testing.assert_allclose(in_own_words(found)["parameter"], [8.0 * TURN, 16.0 * TURN], rtol=1e-14)
    assert found["amplitude"].values.tolist() == [1.0, 2.0]
    assert "level" not in found
    # a table of measured orbits takes the same words
    orbits = tmp_path / "orbits.csv"
    orbits.write_text(f"{column},amplitude\n{values[0]!r},1\n{values[1]!r},2\n")
    np.testing.assert_allclose(read_branch(orbits, load_model("duffing"))["value"], [8.0, 16.0], rtol=1e-15)


def test_read_points__levels_of_other_axes_are_read_in_any_spelling(tmp_path):
    file = written(tmp_path, "amplitude,omega,amp\n0.3,6.283185307179586,1\n0.4,,2\n")
    found = read_points(file, load_model("duffing"), "amplitude", others=["frequency"], needed=(), known=("amp",))
    np.testing.assert_allclose(found["parameter"], [0.3, 0.4])
    np.testing.assert_allclose(found["frequency"], [1.0, np.nan])
    assert found["amp"].values.tolist() == [1.0, 2.0]


def test_spelling_of__a_parameter_of_the_model_stands_before_a_word_of_the_drive():
    model = magpend.model("x' = -omega*x + phi", name="own", omega=1.0, phi=0.0)
    assert spelling_of("omega", model)[0] == "omega"
    assert spelling_of("omega", model)[1](3.0) == 3.0
    assert spelling_of("period", model)[0] == "frequency"
    assert spelling_of("x_deg", model)[0] == "x_deg"


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("amplitude\n1\n", r"no column frequency_hz \(or omega, period\)"),
        ("omega,size\n1,2\n", "no column amplitude; .* it has omega, size"),
        ("omega,frequency_hz,amplitude\n1,2,3\n", "omega and frequency_hz are the same axis"),
        ("frequency_hz,amplitude\n1,x\n", "row 2, amplitude = 'x'"),
        ("frequency_hz,amplitude\n", "no rows"),
        (None, "No such file"),
    ],
)
def test_read_points__are_refused_with_the_file_and_the_column(tmp_path, text, named):
    file = tmp_path / "points.csv"
    if text is not None:
        file.write_text(text)
    with pytest.raises(SpecError, match=named) as refused:
        read_points(file, load_model("duffing"), "frequency")
    assert str(file) in str(refused.value)
