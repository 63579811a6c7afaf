"""What numerical calls refuse, and that none of them runs for ever."""

import numpy as np
import pytest

from magpend_core import (
    accelerations,
    energy,
    evaluate,
    jacobian,
    load_model,
    rates,
    run_branches,
    sections,
    torques,
    trajectory,
)
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from magpend_core.pointwise import drive_level
from magpend_core.status import Status

STATE = [0.1, 0.2, 0.3, 0.4]
DUFFING = load_model("duffing").load()


PACKED, START = np.ones((1, 1, 34)), [[0.1, 0.1, 0.0, 0.0]]
CALLS = {
    "rates": (lambda p, t, state, f: rates(t, state, p, f), {"t": 0.0, "state": STATE, "f": 2.2}),
    "jacobian": (lambda p, t, state, f: jacobian(t, state, p, f), {"t": 0.0, "state": STATE, "f": 2.2}),
    "accelerations": (lambda p, t, state, f: accelerations(t, state, p, f), {"t": 0.0, "state": STATE, "f": 2.2}),
    "torques": (lambda p, t, state, f: torques(t, state, p, f), {"t": 0.0, "state": STATE, "f": 2.2}),
    "energy": (lambda p, state: energy(state, p), {"state": STATE}),
    "evaluate": (lambda p, t: evaluate(["energy"], t, STATE, p, 2.2), {"t": 0.0}),
    "drive": (lambda p, t: drive_level(t, p, 2.2), {"t": 0.0}),
    "trajectory": (trajectory, {"frequency_hz": 2.2, "initial_state": STATE, "times": [0.1]}),
    "sections": (sections, {"frequency_hz": [2.2], "initial_states": START, "n_transient": 0, "n_keep": 1}),
    "branches": (
        lambda p, parameters, frequency_hz: run_branches(
            parameters, frequency_hz, START, n_transient=0, n_keep=1, rtol=1e-8, atol=1e-8, system=PENDULUM_FITTED
        ),
        {"parameters": PACKED, "frequency_hz": [[2.2]]},
    ),
}
"""Numerical calls with arguments that they take."""


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        *((name, {"t": np.nan}, "t = nan") for name in ("rates", "jacobian", "accelerations", "torques", "evaluate")),
        *((name, {"state": [np.inf, *STATE[1:]]}, r"state\[0\] = inf") for name in ("accelerations", "energy")),
        ("rates", {"t": [np.inf], "state": [STATE]}, r"t\[0\] = inf"),
        ("rates", {"t": [0.0, 0.1, 0.2], "state": [STATE, STATE]}, r"t has shape \(3,\)"),
        ("drive", {"t": [0.0, np.inf]}, r"t\[1\] = inf"),
        ("accelerations", {"state": [0.0, 0.0, 0.0]}, "state has 3 numbers"),
        ("accelerations", {"f": 0.0}, "frequency_hz = 0"),
        ("accelerations", {"f": np.inf}, "frequency_hz = inf"),
        ("accelerations", {"f": [2.0, 3.0]}, "frequency_hz has 1 dim"),
        ("trajectory", {"times": [-0.1, 0.2]}, "times must start at 0 or later"),
        ("trajectory", {"times": [0.1, 0.1]}, "rise from entry to entry"),
        ("trajectory", {"times": [0.1, np.nan]}, r"times\[1\] = nan"),
        ("trajectory", {"times": 0.1}, "times has 0 dimensions"),
        ("trajectory", {"initial_state": START}, "initial_state has 2 dimensions"),
        ("trajectory", {"initial_state": [0.0, 0.0]}, "initial_state has 2 numbers"),
        ("trajectory", {"frequency_hz": -1.0}, "frequency_hz = -1"),
        ("trajectory", {"rtol": 1e-14}, "rtol = 1e-14"),
        ("trajectory", {"max_steps_per_period": 0}, "max_steps_per_period = 0"),
        ("sections", {"frequency_hz": [2.2, 2.3]}, "initial_states has 1 rows; frequency_hz has 2 branches"),
        ("sections", {"frequency_hz": [[2.2]]}, "frequency_hz has 2 dimensions"),
        ("sections", {"frequency_hz": [-2.2]}, "frequency_hz = -2.2"),
        ("sections", {"frequency_hz": [np.nan]}, r"frequency_hz\[0\] = nan"),
        ("sections", {"initial_states": START[0]}, "initial_states has 1 dimensions"),
        ("sections", {"initial_states": [[0.1, 0.1, 0.0]]}, "initial_states has 3 numbers per state"),
        ("sections", {"initial_states": [[0.1, np.nan, 0.0, 0.0]]}, r"initial_states\[0, 1\] = nan"),
        ("sections", {"n_transient": -1}, "n_transient = -1"),
        ("sections", {"n_keep": 0}, "n_keep = 0"),
        ("sections", {"n_keep": True}, "n_keep = True is not a whole number"),
        ("sections", {"n_keep": 2.0}, "n_keep = 2.0 is not a whole number"),
        ("sections", {"rtol": 1e-14}, "rtol = 1e-14"),
        ("sections", {"atol": 0.0}, "atol = 0"),
        ("sections", {"closure_tolerance": 0.0}, "closure_tolerance = 0"),
        ("sections", {"max_orbit_period": 0}, "max_orbit_period = 0"),
        ("sections", {"max_steps_per_period": 0}, "max_steps_per_period = 0"),
        ("sections", {"n_lanes": 0}, "n_lanes = 0"),
        ("sections", {"step_size": [1e-3, 1e-3]}, "step_size has 2 rows; frequency_hz has 1 branches"),
        *(("sections", {"stop_when_closed": no}, "neither True nor False") for no in ("no", "false", 0, 1, None, [])),
        ("branches", {"parameters": PACKED[..., :33]}, r"parameters has shape \(1, 1, 33\).*ask for \(1, 1, 34\)"),
        ("branches", {"parameters": np.ones((2, 1, 34))}, r"parameters has shape \(2, 1, 34\).*ask for \(1, 1, 34\)"),
        ("branches", {"parameters": PACKED[0]}, "parameters has 2 dimensions"),
        ("branches", {"parameters": np.nan * PACKED}, r"parameters\[0, 0, 0\] = nan"),
        ("branches", {"frequency_hz": [2.2]}, "frequency_hz has 1 dimensions"),
    ],
)
def test_calls__name_the_bad_argument(preset, name, change, words):
    call, good = CALLS[name]
    with pytest.raises(ValueError, match=words):
        call(preset, **(good | change))


def test_sections__masked_entries_are_refused():
    masked = np.ma.array([[0.1, 0.0], [0.2, 0.0]], mask=[[False, False], [True, False]])
    for states in (masked, list(masked)):
        with pytest.raises(ValueError, match="initial_states has 1 masked entries"):
            sections(DUFFING, 0.2, states, n_transient=0, n_keep=1)
    frequency = np.ma.array([0.2, 0.3], mask=[True, False])
    with pytest.raises(ValueError, match="frequency_hz has 1 masked"):
        sections(DUFFING, frequency, masked.data, n_transient=0, n_keep=1)
    # without a masked entry it is an array like any other
    whole = sections(DUFFING, 0.2, np.ma.array(masked.data), n_transient=0, n_keep=1)
    plain = sections(DUFFING, 0.2, masked.data, n_transient=0, n_keep=1)
    assert np.array_equal(whole.section, plain.section)


@pytest.mark.parametrize("frequency", [1e-300, 1e-180, 1e9, 1e180, 1e300])
def test_sections__absurd_frequencies_end(frequency):
    found = sections(DUFFING, frequency, [[0.1, 0.0], [0.0, 0.0]], n_transient=1, n_keep=1)
    assert set(found.status) <= {
        Status.PERIODIC,
        Status.BOUNDED,
        Status.DIVERGED,
        Status.STEP_LIMIT,
        Status.STEP_UNDERFLOW,
    }


@pytest.mark.parametrize("start", [1e308, -1e308, 1e200, 1e20])
def test_sections__absurd_states_diverge(start):
    found = sections(DUFFING, 0.2, [[start, 0.0]], n_transient=1, n_keep=1)
    assert found.status[0] in (Status.DIVERGED, Status.STEP_UNDERFLOW)
    assert np.isnan(found.section).all()


@pytest.mark.slow
def test_trajectory__absurd_arguments_end(preset):
    times = np.linspace(0.0, 1.0, 5)
    with pytest.raises(ValueError, match=r"1e\+180 periods .* at most 1e\+07"):
        trajectory(preset, 1e180, STATE, times)
    for value in (1e308, 1e100, -1e308):
        with pytest.raises(ArithmeticError, match="left the bounds"):
            trajectory(preset, 2.2, [value] * 4, times)


@pytest.mark.parametrize("name", ["eps", "eps_mag", "eps_drive"])
@pytest.mark.parametrize("state", [STATE, [0.0] * 4, [0.0, 0.1, 0.0, 0.0]])
def test_sections__absurd_steepness_ends(preset, name, state):
    found = sections(preset.replace(**{name: 1e180}), 2.2, [state], n_transient=0, n_keep=1)
    assert found.status[0] != Status.PENDING
