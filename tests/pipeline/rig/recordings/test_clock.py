"""Clocks: even time, gaps, jitter, channels that begin or end apart, rates that do not fit."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipeline.rig.recordings import findings_of, recording_of, window
from pipeline.rig.recordings.channels import Channel
from pipeline.rig.recordings.mapping import parse_mapping
from pipeline.rig.recordings.reading import read_raw
from pipeline.specification.problems import SpecError


def stamped(make, stamps, **more):
    """Recording with a channel of time stamps."""
    n = len(stamps)
    a, b = make.swing(n)
    mapping = make.mapping(tables={"time": {"channel": "t", **more}})
    return recording_of(make.raw(make.channels({"t": stamps, "a": a, "b": b}, step_s=np.nan)), mapping)


@pytest.mark.parametrize(
    ("stamps", "unit", "rate_hz"),
    [
        (np.round(17.25 + np.arange(5000) / 3000.0, 6), "s", 3000.0),  # cut to microseconds: a round rate
        (np.arange(4000) / 997.3137, "s", 997.3137),  # one that is not round stays as it is
        (np.arange(1000) * 2.0, "ms", 500.0),
    ],
)
def test_clock__rate_of_even_stamps(make, stamps, unit, rate_hz):
    ds = stamped(make, stamps, unit=unit)
    assert ds.attrs["sampling_rate_hz"] == pytest.approx(rate_hz, rel=1e-9 if rate_hz % 1 else 0)
    assert findings_of(ds) == []
    np.testing.assert_allclose(ds["time"], np.arange(len(stamps)) / rate_hz, atol=1e-12)


def test_clock__gap_begins_a_new_piece(make):
    stamps = make.time.copy()
    stamps[700:] += 0.5
    stamps[1500:] += 0.004  # two samples
    ds = stamped(make, stamps)
    found = findings_of(ds)
    assert [f.kind for f in found] == ["gap", "gap"]
    assert (found[0].start_s, found[0].end_s) == (pytest.approx(stamps[699]), pytest.approx(stamps[700]))
    assert "250 samples are missing" in found[0].text
    assert "2 samples are missing" in found[1].text
    assert np.flatnonzero(np.diff(ds["piece"])).tolist() == [699, 1499]
    np.testing.assert_allclose(ds["time"], stamps, atol=1e-9)


def test_clock__jitter_is_told_and_time_is_even(make):
    rng = np.random.default_rng(1)
    stamps = make.time + rng.uniform(-0.2, 0.2, make.n) * make.step_s
    ds = stamped(make, stamps)
    (found,) = findings_of(ds)
    assert (found.kind, found.severity) == ("jitter", "note")
    assert f"{0.2 * make.step_s / 3**0.5:.2g}"[:4] in found.text  # 0.00023: standard deviation
    assert np.ptp(np.diff(ds["time"])) < 1e-12
    np.testing.assert_allclose(ds["time"], make.time - make.time[0], atol=0.3 * make.step_s)


def test_clock__late_stamps_are_no_gap_and_gaps_are_found_among_them(make):
    """Jitter so strong that neighbours stand more than one and a half steps apart."""
    rng = np.random.default_rng(1)
    stamps = make.time + rng.uniform(-0.35, 0.35, make.n) * make.step_s
    assert np.diff(stamps).max() > 1.6 * make.step_s
    stamps[900:] += 0.7
    stamps[1400:] += make.step_s  # a single sample
    ds = stamped(make, stamps)
    found = findings_of(ds)
    assert [f.kind for f in found] == ["gap", "gap", "jitter"]
    assert "350 samples" in found[0].text
    assert "1 samples" in found[1].text
    assert ds.attrs["sampling_rate_hz"] == pytest.approx(500.0, rel=1e-4)


def test_clock__uneven_sampling_is_a_warning(make):
    """A clock that runs two samples ahead in the middle of the recording."""
    stamps = make.time + 2.0 * make.step_s * np.sin(np.pi * np.arange(make.n) / make.n)
    (found,) = findings_of(stamped(make, stamps))
    assert (found.kind, found.severity) == ("jitter", "warning")
    assert "resample" in found.text


def test_clock__stamps_coarser_than_the_sampling(make):
    """Stamps in whole milliseconds of a sampling at 3 kHz: three alike, and then the next."""
    ds = stamped(make, np.floor(np.arange(6000) / 3.0 + 1e-9) * 1e-3)
    assert ds.attrs["sampling_rate_hz"] == pytest.approx(3000.0, rel=1e-4)
    assert [f.kind for f in findings_of(ds)] == ["jitter"]
    assert len(np.unique(ds["piece"])) == 1


def test_clock__rates_that_do_not_fit_are_refused(make):
    a, b = make.swing()
    channels = {"a": Channel("a", a, step_s=0.001), "b": Channel("b", b[::2], step_s=0.002)}
    with pytest.raises(SpecError, match=r"different sampling rates \(psi1 1000 Hz, psi2 500 Hz\); map channels"):
        recording_of(make.raw(channels), make.mapping())
    backwards = make.time - 1.0 * (np.arange(make.n) >= 1000)
    with pytest.raises(SpecError, match=r"goes backwards after sample 999 .* give sampling_rate_hz"):
        stamped(make, backwards)
    raw = make.raw(make.channels(dict(zip("ab", make.swing(), strict=True)), step_s=np.nan))
    with pytest.raises(SpecError, match=r"psi1, psi2 is not known; add .* time = .* or sampling_rate_hz"):
        recording_of(raw, make.mapping())
    stated = make.mapping().model_copy(update={"sampling_rate_hz": 500.0})
    assert recording_of(raw, stated).attrs["sampling_rate_hz"] == 500.0


def test_clock__irregular_sampling_is_named_and_its_remedy_helps(make):
    stamps = np.cumsum(np.random.default_rng(5).uniform(0.005, 0.035, 2000))
    raw = make.raw(make.channels({"t": stamps, "a": 0.3 * np.sin(2.0 * stamps), "b": stamps}, step_s=np.nan))
    mapping = make.mapping(tables={"time": {"channel": "t"}})
    with pytest.raises(
        SpecError, match=r"irregular times, with steps of 5\.\d* to 34\.\d* ms.*resample = 5\d"
    ) as caught:
        recording_of(raw, mapping)
    rate = float(str(caught.value).partition("resample = ")[2].partition(",")[0])
    ds = recording_of(raw, mapping.model_copy(update={"resample": rate}))
    assert int(ds["piece"].max()) == 0
    assert ds.attrs["sampling_rate_hz"] == pytest.approx(rate)
    assert not [f for f in findings_of(ds) if f.kind in ("gap", "jitter")]
    # linear interpolation over steps of at most 35 ms: at most h^2/8 max |a''| = 2e-4
    np.testing.assert_allclose(ds["psi1"], 0.3 * np.sin(2.0 * (ds["time"].values + stamps[0])), atol=2e-4)
    # gaps of even sampling are not irregular
    kept = np.random.default_rng(1).uniform(size=make.n) > 0.1
    assert int(stamped(make, make.time[kept])["piece"].max()) > 100


def test_clock__stated_rate_that_is_not_the_files(make):
    stated = make.mapping().model_copy(update={"sampling_rate_hz": 250.0})
    ds = recording_of(make.raw(make.channels(dict(zip("ab", make.swing(), strict=True)))), stated)
    assert {f.kind for f in findings_of(ds)} == {"rate"}
    assert ds.attrs["sampling_rate_hz"] == 250.0


def test_clock__stated_rate_beside_time_stamps_is_noted(make):
    """A gap in stamps that are not used cannot be found: that much is said."""
    a, b = make.swing()
    stamps = make.time + 0.5 * (make.time > 2.0)
    channels = {n: Channel(n, v, time=stamps) for n, v in (("a", a), ("b", b))}
    stated = make.mapping().model_copy(update={"sampling_rate_hz": 500.0})
    ds = recording_of(make.raw(channels), stated)
    assert {(f.kind, f.severity) for f in findings_of(ds)} == {("rate", "note")}
    np.testing.assert_allclose(ds["time"], make.time, atol=1e-12)
    assert [f.kind for f in findings_of(recording_of(make.raw(channels), make.mapping()))] == ["gap"]


def test_clock__channels_that_begin_apart(make):
    """Channel b began 50 samples late: what both saw at one instant stands at one place."""
    a, b = make.swing()
    channels = make.channels({"a": a, "b": b[50:]}, starts={"a": 7.0, "b": 7.1})
    ds = recording_of(make.raw(channels), make.mapping())
    (found,) = findings_of(ds)
    assert (found.kind, found.channel) == ("start", "psi1")
    assert "50 samples" in found.text
    np.testing.assert_array_equal(ds["psi1"], a[50:])
    np.testing.assert_array_equal(ds["psi2"], b[50:])
    assert float(ds["time"][0]) == 0.0
    channels = make.channels({"a": a, "b": b}, starts={"a": 0.0, "b": 0.3 * make.step_s})
    (found,) = findings_of(recording_of(make.raw(channels), make.mapping()))
    assert (found.kind, found.channel) == ("start", "psi1")
    assert "0.0006 s before the others" in found.text
    channels = make.channels({"a": a, "b": b}, starts={"a": 0.0, "b": 100.0})
    with pytest.raises(SpecError, match="no stretch in common"):
        recording_of(make.raw(channels), make.mapping())


def test_clock__stretches_without_a_common_clock_are_laid_one_after_another(make):
    a, b = make.swing()
    halves = [make.channels({"a": a[s], "b": b[s]}) for s in (slice(0, 800), slice(800, None))]
    ds = recording_of(make.raw(*halves), make.mapping())
    (found,) = findings_of(ds)
    assert (found.kind, found.severity) == ("pieces", "note")
    np.testing.assert_allclose(ds["time"], make.time, atol=1e-12)
    assert np.flatnonzero(np.diff(ds["piece"])).tolist() == [799]


def test_clock__stretches_that_follow_on_are_one_piece(make):
    a, b = make.swing()
    first = make.channels({"a": a[:800], "b": b[:800]})
    second = make.channels({"a": a[800:], "b": b[800:]}, starts=dict.fromkeys("ab", 1.6))
    ds = recording_of(make.raw(first, second), make.mapping())
    assert findings_of(ds) == []
    assert not ds["piece"].any()


@pytest.mark.parametrize(("axis", "key"), [("t", "time"), ("k", "piece")])
@pytest.mark.parametrize("n", [1500, 2500])
def test_timed__stamps_or_numbers_of_another_length_are_a_finding(make, axis, key, n):
    a, b = make.swing()
    values = np.arange(n) * make.step_s if axis == "t" else (np.arange(n) > 700).astype(float)
    mapping = make.mapping(tables={key: {"channel": axis}})
    ds = recording_of(make.raw(make.channels({axis: values, "a": a, "b": b})), mapping)
    assert ds.sizes["sample"] == min(n, make.n)
    told = {(f.kind, f.channel) for f in findings_of(ds)}
    assert told == ({("length", "psi1"), ("length", "psi2")} if n < make.n else {("length", key)})
    assert len(np.unique(ds["piece"])) == (1 if axis == "t" else 2)


def test_resolved__missing_channels_are_named_with_the_nearest(make):
    raw = make.raw(make.channels({"rig/angle 1": make.swing()[0], "rig/motor": make.swing()[1]}))
    mapping = parse_mapping(
        {"model": "pendulum", "channels": {"psi1": {"channel": "rig/angle1"}, "psi2": {"channel": 7}}}
    )
    with pytest.raises(SpecError) as caught:
        recording_of(raw, mapping)
    assert len(caught.value.problems) == 2
    assert "did you mean rig/angle 1?" in caught.value.problems[0]
    assert "channels.psi2.channel = 7" in caught.value.problems[1]


def test_resolved__a_unit_in_the_name_may_be_missing_where_the_mapping_gives_it(tmp_path):
    """The angles are those that were written, in radians by hand."""
    path = tmp_path / "x.csv"
    rows = [(0.01 * i, 20.0 * math.sin(0.1 * i)) for i in range(200)]
    path.write_text("Zeit [s],Winkel oben [deg]\n" + "".join(f"{t:.2f},{a!r}\n" for t, a in rows), "utf-8")
    channel = {"channel": "Winkel oben", "unit": "deg"}
    tables = {"model": "pendulum", "time": {"channel": "Zeit"}, "channels": {"psi1": channel}}
    ds = recording_of(read_raw(path), parse_mapping(tables))
    np.testing.assert_allclose(ds["psi1"], [a * math.pi / 180 for _, a in rows], rtol=1e-12)
    assert [(f.kind, f.channel, f.severity) for f in findings_of(ds)] == [
        ("name", "psi1", "warning"),
        ("name", "time", "warning"),
    ]
    assert "'Winkel oben [deg]', the mapping's 'Winkel oben'" in findings_of(ds)[0].text
    whole = {**tables, "time": {"channel": "Zeit [s]"}, "channels": {"psi1": {**channel, "channel": 2}}}
    assert findings_of(recording_of(read_raw(path), parse_mapping(whole))) == []


@pytest.mark.parametrize(
    ("head", "unit", "words"),
    [
        ("Zeit [s],Winkel oben [deg]", "", "Write the whole name, or add unit = 'deg'."),
        ("Zeit [s],Winkel oben [deg],Winkel oben (mrad)", "deg", "did you mean"),
        ("Zeit [ms],Winkel oben [deg]", "deg", "time.channel = 'Zeit'"),
    ],
)
def test_resolved__a_name_without_its_unit_is_refused_where_it_says_too_little(tmp_path, head, unit, words):
    path = tmp_path / "x.csv"
    n_columns = head.count(",") + 1
    rows = [",".join(f"{x}" for x in (0.01 * i, i % 7, i % 5)[:n_columns]) for i in range(50)]
    path.write_text("\n".join([head, *rows]) + "\n")
    channel = {"channel": "Winkel oben", **({"unit": unit} if unit else {})}
    tables = {"model": "pendulum", "time": {"channel": "Zeit"}, "channels": {"psi1": channel}}
    with pytest.raises(SpecError) as caught:
        recording_of(read_raw(path), parse_mapping(tables))
    (problem,) = caught.value.problems
    assert words in problem


def test_window__keeps_time_and_the_findings_in_it(make):
    ds = window(make.recorded(), (1.0, 2.0))
    assert float(ds["time"][0]) == pytest.approx(1.0)
    assert ds.sizes["sample"] == 501
    stamps = make.time + 0.5 * (np.arange(make.n) >= 700) + 0.5 * (np.arange(make.n) >= 1500)
    ds = stamped(make, stamps)
    assert len(findings_of(ds)) == 2
    (found,) = findings_of(window(ds, (2.0, 4.5)))
    assert found.start_s == pytest.approx(stamps[1499])
    with pytest.raises(SpecError, match=r"window_s = \[10, 20\]: holds 0 samples"):
        window(ds, (10.0, 20.0))
