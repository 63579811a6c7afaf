"""The virtual rig: its states are those of the engine, its sensors those that were asked for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from magpend_core import load_preset, trajectory
from magpend_core.models.preset_writing import write_preset
from pipeline.rig.recordings import findings_of, parse_mapping, read_recording, write_raw
from pipeline.rig.virtual import (
    RECORD_RTOL,
    DriveSensor,
    Sensor,
    Step,
    load_rig,
    parse_rig,
    readings,
    record,
    simulated,
)
from pipeline.specification.problems import SpecError

TIMES = np.arange(3000) / 500.0
START = (0.6, -0.2, 0.0, 0.0)


@pytest.fixture(scope="module")
def parameters():
    return load_preset(duty_cycle=0.4927)


def ideal(*names):
    return {name: Sensor() for name in names}


def recorded(parameters, sensors, start=START, times=TIMES):
    """Recording of fourteen periods at 2.2 Hz."""
    return record(parameters, [Step(2.2, 14)], start, times, sensors=sensors, seed=0)


def test_record__ideal_sensors_see_the_engines_states(parameters):
    ds = recorded(parameters, {**ideal("psi1", "psi2", "psi1_dot"), "drive": DriveSensor("torque")})
    states = trajectory(parameters, 2.2, np.array(START), TIMES, rtol=RECORD_RTOL, atol=RECORD_RTOL)
    for i, name in ((0, "psi1"), (1, "psi2"), (2, "psi1_dot")):
        # both walk the drive's periods with the same steps; what differs is rounding, which chaos lets grow
        np.testing.assert_allclose(ds[name][:1500], states[:1500, i], atol=1e-8)
    phase = (math.pi - 2.0 * math.pi * 0.4927) / 2.0  # Wojna et al. (2018), Eq. 12-15
    wave = np.sin(2.0 * math.pi * 2.2 * TIMES + phase) - math.sin(phase)
    torque = parameters["q"] * 2.0 / math.pi * np.arctan(parameters["eps_drive"] * wave)
    np.testing.assert_allclose(ds["drive"], torque, atol=1e-8)
    assert ds.attrs["simulated"] == 1
    assert "duty_cycle = 0.4927" in ds.attrs["parameters"]
    assert findings_of(ds) == []


@pytest.mark.slow
def test_record__steps_of_the_drive_carry_the_state_on(parameters):
    """Against scipy, step by step: another frequency, another duty cycle, and the drive off."""
    from scipy.integrate import solve_ivp

    from magpend_core import rates

    steps = [Step(2.0, 2), Step(2.5, 3, {"duty_cycle": 0.6}), Step(1.0, 1, {"q": 0.0})]
    times = np.arange(1550) / 500.0
    ds = record(parameters, steps, START, times, sensors=ideal("psi1", "psi2"), seed=0)
    begin, state = 0.0, np.array(START)
    for step in steps:
        own = parameters.replace(**dict(step.values))
        for _ in range(step.n_periods):
            end = begin + 1.0 / step.frequency_hz
            inside = (times >= begin - 1e-12) & (times < end - 1e-12)

            def slope(t, y, own=own, f=step.frequency_hz):
                return rates(t, y, own, f)

            local = np.maximum(times[inside] - begin, 0.0)
            found = solve_ivp(
                slope, (0.0, end - begin), state, t_eval=[*local, end - begin], rtol=1e-9, atol=1e-9, max_step=2e-3
            )
            np.testing.assert_allclose(ds["psi1"].values[inside], found.y[0, :-1], atol=1e-5)
            np.testing.assert_allclose(ds["psi2"].values[inside], found.y[1, :-1], atol=1e-5)
            begin, state = end, found.y[:, -1]


def test_record__drive_signal_follows_the_steps(parameters):
    """Each step's edges count from its own beginning, which is no whole period of its frequency."""
    steps = [Step(2.0, 1), Step(3.7, 4, {"duty_cycle": 0.3}), Step(1.0, 1, {"q": 0.0})]
    times = np.arange(1000) / 500.0
    sensors = {"psi1": Sensor(), "drive": DriveSensor("signal")}
    signal = record(parameters, steps, START, times, sensors=sensors, seed=0)["drive"].values
    wanted = np.where(np.mod(times * 2.0, 1.0) < 0.4927, 1.0, -1.0)
    second = (times >= 0.5) & (times < 0.5 + 4 / 3.7)
    wanted[second] = np.where(np.mod((times[second] - 0.5) * 3.7 + 1e-9, 1.0) < 0.3, 1.0, -1.0)
    wanted[times >= 0.5 + 4 / 3.7] = 0.0
    np.testing.assert_array_equal(signal, wanted)


def test_record__noise_and_quantisation_are_those_of_the_sensor(parameters):
    ideal_ds = recorded(parameters, ideal("psi1", "psi2"))
    ds = recorded(parameters, {"psi1": Sensor("encoder", 2e-3), "psi2": Sensor("encoder", 0.0, 12)})
    error = ds - ideal_ds
    assert float(error["psi1"].std()) == pytest.approx(2e-3, rel=0.05)
    grain = 2.0 * math.pi / 2**12
    assert float(np.abs(error["psi2"]).max()) == pytest.approx(grain / 2, rel=0.02)
    assert float(error["psi2"].std()) == pytest.approx(grain / 12**0.5, rel=0.05)
    for kind in ("encoder", "potentiometer"):  # an offset is what the mapping does not know
        ds = recorded(parameters, {"psi1": Sensor(kind, offset=0.02)})
        np.testing.assert_allclose(ds["psi1"] - ideal_ds["psi1"], 0.02, atol=1e-12)


def test_record__potentiometer_over_the_top(parameters):
    """A link that turns over is not measured in the dead band, and its turns are counted."""
    sensors = {"psi1": Sensor("potentiometer", 1e-3, 12, 0.3), "psi2": Sensor("potentiometer", 1e-3, 12, 0.3)}
    start = (0.0, 0.0, 0.0, 25.0)
    times = np.arange(1000) / 500.0
    true = recorded(parameters, ideal("psi2"), start, times)["psi2"].values
    ds = recorded(parameters, sensors, start, times)
    assert np.ptp(true) > 2.0 * math.pi
    assert {f.kind for f in findings_of(ds)} == {"dead-band", "wrap"}
    measured = ds["psi2"].values
    folded = np.abs(np.mod(true + math.pi, 2.0 * math.pi) - math.pi)
    assert (np.isnan(measured) == (folded > math.pi - 0.15)).all()
    known = np.isfinite(measured)
    assert np.abs(measured - true)[known].max() < 0.008  # five standard deviations and half a grain


def test_readings__through_a_file_are_the_recording(tmp_path, parameters):
    sensors = {"psi1": Sensor("potentiometer", 1e-3, 12, 0.2), "drive": DriveSensor("signal", 0.02)}
    arguments = (parameters, [Step(2.2, 14)], START, TIMES)
    raw, mapping = readings(*arguments, sensors=sensors, seed=4)
    again = [readings(*arguments, sensors=sensors, seed=seed)[0].stretches[0]["rig/psi1"].values for seed in (4, 5)]
    np.testing.assert_array_equal(raw.stretches[0]["rig/psi1"].values, again[0])
    assert np.abs(again[0] - again[1]).max() > 0.0
    path = write_raw(raw, tmp_path / "x.csv")
    mapping = parse_mapping(mapping.toml().replace("model =", 'time = { channel = "time" }\nmodel ='))
    found = read_recording(path, mapping)
    wanted = record(*arguments, sensors=sensors, seed=4)
    for name in ("psi1", "drive"):
        np.testing.assert_array_equal(found[name], wanted[name])
    assert found.attrs["simulated"] == 1


def test_record__refuses_all_at_once(parameters):
    with pytest.raises(SpecError) as caught:
        record(
            parameters,
            [Step(2.2, 2, {"duty": 0.5}), Step(0.0, 1)],
            START,
            TIMES,
            seed=0,
            sensors={"psi_1": Sensor(), "psi1_dot": Sensor("potentiometer"), "psi2": Sensor(noise=-1.0)},
        )
    text = "\n".join(caught.value.problems)
    assert "unknown state 'psi_1'; did you mean psi1" in text
    assert "measures angles alone" in text
    assert "sensors.psi2.noise = -1.0" in text
    assert "unknown parameter 'duty'; did you mean duty_cycle?" in text
    assert "drive.steps[1]: frequency_hz must be above 0" in text
    with pytest.raises(SpecError, match=r"last 0\.909091 s together, the recording 5\.998 s; add"):
        record(parameters, [Step(2.2, 2)], START, TIMES, sensors=ideal("psi1"), seed=0)


SPEC = """
model = "pendulum"
initial_state = { psi1_deg = 40.0, psi2 = 0.1 }
sampling_rate_hz = 500.0
seed = 1
[parameters]
q = 1.4
[drive]
kind = "signal"
noise = 0.02
steps = [{ frequency_hz = 2.0, n_periods = 4 }, { frequency_hz = 2.5, n_periods = 5, duty_cycle = 0.5 }]
[sensors.psi1]
kind = "potentiometer"
noise = 1e-3
bits = 12
dead_band = 0.2
"""


def test_load_rig__reads_a_specification(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(SPEC)
    rig = load_rig(path)
    assert rig.initial_state == pytest.approx((math.radians(40.0), 0.1, 0.0, 0.0))
    assert rig.drive == (Step(2.0, 4, {}), Step(2.5, 5, {"duty_cycle": 0.5}))
    assert len(rig.times) == 2000  # four seconds: as long as the drive
    raw, mapping = simulated(rig, is_csv=True)
    assert mapping.time.channel == "time"
    assert set(raw.stretches[0]) == {"rig/psi1", "rig/drive"}


def test_parse_rig__sweep_is_its_steps():
    data = {
        "model": "pendulum",
        "sampling_rate_hz": 100.0,
        "sensors": {"psi1": {"kind": "encoder"}},
        "drive": {"sweep": {"start_hz": 3.0, "stop_hz": 2.0, "num": 5, "n_periods": 6}},
    }
    rig = parse_rig(data)
    assert [s.frequency_hz for s in rig.drive] == [3.0, 2.75, 2.5, 2.25, 2.0]
    assert {s.n_periods for s in rig.drive} == {6}
    data["drive"]["steps"] = [{"frequency_hz": 1.0, "n_periods": 1}]
    with pytest.raises(SpecError, match="drive: give steps or sweep, one of them"):
        parse_rig(data)


WRONG = {
    "model": "pendulum",
    "sampling_rate": 10.0,
    "sampling_rate_hz": -1.0,
    "preset": "wojna2018",
    "initial_state": {"psi": 1.0, "psi1": math.inf},
    "drive": {"steps": [{"frequency_hz": 2.0}, {"frequency_hz": 2.0, "n_periods": 1, "Q": 1.0}]},
    "sensors": {"psi1": {"kind": "camera"}},
}


@pytest.mark.parametrize(
    ("data", "keys"),
    [
        (
            WRONG,
            "sampling_rate: sampling_rate_hz initial_state.psi: initial_state.psi1 drive.steps[0].n_periods "
            "drive.steps[1]: sensors.psi1.kind",
        ),
        ({}, "model:"),
        ({"model": "pendulum", "preset": "none"}, "preset"),
        ({"model": "pendulum", "sampling_rate_hz": 100.0}, "duration_s:"),
        ({"model": "pendulum", "sampling_rate_hz": 100.0, "duration_s": 1.0}, "sensors:"),
        ({"model": "pendulum", "sensors": 3}, "sensors"),
    ],
)
def test_parse_rig__names_all_problems_at_once(data, keys):
    with pytest.raises(SpecError) as caught:
        parse_rig(data)
    for key in keys.split():
        assert any(key in p for p in caught.value.problems), (key, caught.value.problems)


def test_load_rig__finds_a_presets_file_beside_it(tmp_path, monkeypatch):
    """Wherever the command is given from."""
    values = load_preset(T1=0.095)
    write_preset(tmp_path / "own.toml", "pendulum", values.as_dict(), dict.fromkeys(values.names, "a test"), "own")
    rig = 'model = "pendulum"\npreset = "own.toml"\nsampling_rate_hz = 100.0\nduration_s = 1.0\n'
    (tmp_path / "rig.toml").write_text(rig + '[sensors.psi1]\nkind = "encoder"\n')
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load_rig(tmp_path / "rig.toml").parameters["T1"] == 0.095
