"""Parameters at which equations have no value: bad input, or cells with a status."""

from __future__ import annotations

import numpy as np
import pytest

from magpend_core import Status
from pipeline import open_run
from pipeline.runs.run import run
from pipeline.specification.problems import SpecError

SPEC = """
kind = "sweep"
{axes}
[model]
name = "probe"
states = {{ x = {{ }}, v = {{ }} }}
parameters = {{ d = {d} }}
equations = {{ x = "v", v = "cos(2*pi*f*t) - {rate} - x" }}
[parameters]
frequency_hz = 0.2
[initial_conditions]
kind = "list"
points = [[0.1, 0.0]]
[integration]
n_transient = 1
n_keep = 2
rtol = 1e-5
atol = 1e-5
"""

TOUCHES = "[axes]\nd = { start = 0.0, stop = 1.0, num = 3 }"
AROUND = "[axes]\nd = { start = -1.0, stop = 1.0, num = 3 }"


def spec_of(tmp_path, rate, d, axes=""):
    path = tmp_path / "spec.toml"
    path.write_text(SPEC.format(rate=rate, d=d, axes=axes))
    return path


@pytest.mark.parametrize(
    ("rate", "d", "axes", "lost"),
    [
        ("v/d", 0.0, TOUCHES, [0]),
        ("v/d", 0.1, AROUND, [1]),
        ("v*(1 + log(d))", 0.1, TOUCHES, [0]),
        ("v*(1 + sqrt(d))", 0.0, AROUND, [0]),
    ],
)
def test_run__an_axis_that_touches_a_pole_gives_cells_with_a_status(tmp_path, rate, d, axes, lost):
    run(spec_of(tmp_path, rate, d, axes), tmp_path / "run", workers=0, echo=lambda line: None)
    ds = open_run(tmp_path / "run")
    ended = np.isin(ds.status.values.ravel(), [Status.STEP_UNDERFLOW, Status.DIVERGED])
    assert np.flatnonzero(ended).tolist() == lost
    assert np.isfinite(ds.section.values.reshape(3, -1)[~ended]).all()


def test_run__a_guard_without_a_state_is_one(tmp_path):
    """The integral of a rate that has no value at d = 0, behind a condition that says so."""
    values = []
    for rate in ("where(d > 0, v/d, v)", "v"):
        path = spec_of(tmp_path, rate, 0.0)
        run(path, tmp_path / rate[:5], workers=0, echo=lambda line: None)
        values.append(open_run(tmp_path / rate[:5]).section.values)
    np.testing.assert_allclose(values[0], values[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        ("v/d", "v/d: division by 0 at d = 0, in every state"),
        ("where(x < 9, v, log(d))", "log(d): logarithm of 0 at d = 0, in every state"),
        ("where(x < 9, v, 10**400)", "10**400: too large a number, in every state"),
    ],
)
def test_run__refuses_parts_without_a_value(tmp_path, rate, words):
    with pytest.raises(SpecError) as caught:
        run(spec_of(tmp_path, rate, 0.0), tmp_path / "run", workers=0, echo=lambda line: None)
    assert f"model.equations.v: {words}" in str(caught.value)
    assert not (tmp_path / "run").exists()
