"""What numerical calls refuse, and that none of them runs for ever."""

import numpy as np
import pytest

from magpend_core import accelerations, energy, evaluate, jacobian, load_model, rates, sections, torques, trajectory
from magpend_core.pointwise import drive_level
from magpend_core.status import Status

STATE = [0.1, 0.2, 0.3, 0.4]
DUFFING = load_model("duffing").load()


@pytest.mark.parametrize("call", [rates, jacobian, accelerations, torques])
@pytest.mark.parametrize("t", [np.nan, np.inf, [np.nan]])
def test_pointwise__times_that_are_not_finite(preset, call, t):
    with pytest.raises(ValueError, match=r"t(\[0\])? = (nan|inf) is not finite"):
        call(t, STATE if np.ndim(t) == 0 else [STATE], preset, 2.2)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_pointwise__states_frequencies_and_times_that_are_not_finite(preset, bad):
    state = [bad, *STATE[1:]]
    with pytest.raises(ValueError, match=r"state\[0\] = .* is not finite"):
        accelerations(0.0, state, preset, 2.2)
    with pytest.raises(ValueError, match=r"state\[0\] = .* is not finite"):
        energy(state, preset)
    with pytest.raises(ValueError, match=r"frequency_hz = .* is not finite"):
        accelerations(0.0, STATE, preset, bad)
    with pytest.raises(ValueError, match=r"t = .* is not finite"):
        evaluate(["energy"], bad, STATE, preset, 2.2)
    with pytest.raises(ValueError, match=r"t\[1\] = .* is not finite"):
        drive_level([0.0, bad], preset, 2.2)


def test_pointwise__times_of_another_shape(preset):
    with pytest.raises(ValueError, match=r"t has shape \(3,\).* one per state: \(2,\)"):
        rates([0.0, 0.1, 0.2], [STATE, STATE], preset, 2.2)


@pytest.mark.parametrize("value", ["no", "false", 0, 1, None, []])
def test_sections__stop_when_closed_is_a_truth_value(value):
    with pytest.raises(ValueError, match=r"stop_when_closed = .* is neither True nor False"):
        sections(DUFFING, 0.2, [[0.1, 0.0]], n_transient=0, n_keep=1, stop_when_closed=value)


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
