"""Files of every format: what stands in them is what is read, and what is broken is said."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from pipeline.rig.recordings import findings_of, parse_mapping, read_recording
from pipeline.rig.recordings.mapping import CsvMap
from pipeline.rig.recordings.reading import read_raw
from pipeline.specification.problems import SpecError

from .lvm_files import lvm_segment, written_lvm

pytestmark = pytest.mark.slow  # needs nptdms

RIG = {"channels": {"psi1": {"channel": "rig/angle 1"}, "psi2": {"channel": "rig/angle 2"}}, "model": "pendulum"}


def write_tdms(path, columns, *, segments=1, **properties):
    """TDMS file of channels of the group rig; properties by channel are dictionaries."""
    import nptdms

    parts = {n: np.array_split(np.asarray(v), segments) for n, v in columns.items()}
    with nptdms.TdmsWriter(str(path)) as writer:
        for i in range(segments):
            writer.write_segment(
                [nptdms.ChannelObject("rig", n, part[i], properties.get(n, {})) for n, part in parts.items()]
            )


# ---- TDMS ----------------------------------------------------------------------------------------


def test_read_tdms__starts_are_read_beyond_microseconds(tmp_path, make):
    """At 2 MHz, half a microsecond is a sample."""
    import nptdms

    a, b = make.swing()
    path = tmp_path / "fast.tdms"
    stamps = [nptdms.timestamp.TdmsTimestamp(3_800_000_000, int(x * 2**64)) for x in (0.25, 0.2500005)]
    waves = [{"wf_increment": 5e-7, "wf_start_time": s} for s in stamps]
    write_tdms(path, {"angle 1": a, "angle 2": b}, **{"angle 1": waves[0], "angle 2": waves[1]})
    ds = read_recording(path, parse_mapping(RIG))
    (start, length) = findings_of(ds)
    assert (start.kind, start.channel, "1 samples" in start.text) == ("start", "psi1", True)
    assert (length.kind, length.channel) == ("length", "psi2")
    np.testing.assert_array_equal(ds["psi1"], a[1:])
    np.testing.assert_array_equal(ds["psi2"], b[:-1])


def test_read_tdms__time_stamps_as_a_channel(tmp_path, make):
    a, b = make.swing()
    path = tmp_path / "stamped.tdms"
    stamps = np.datetime64("2026-03-01T12:00:00", "us") + np.round(make.time * 1e6).astype("timedelta64[us]")
    write_tdms(path, {"angle 1": a, "angle 2": b, "t": stamps})
    ds = read_recording(path, parse_mapping({**RIG, "time": {"channel": "rig/t"}}))
    assert ds.attrs["sampling_rate_hz"] == 500.0
    assert findings_of(ds) == []


def test_read_tdms__truncated_file_is_a_finding(tmp_path, make, caplog):
    """npTDMS only warns; cut anywhere in its data, the file says how much is missing."""
    a, b = make.swing()
    path = tmp_path / "whole.tdms"
    wave = {"wf_increment": 0.002}
    write_tdms(path, {"angle 1": a, "angle 2": b}, **{"angle 1": wave, "angle 2": wave})
    cut = tmp_path / "cut.tdms"
    cut.write_bytes(path.read_bytes()[: -500 * 8])
    with caplog.at_level(logging.WARNING):
        ds = read_recording(cut, parse_mapping(RIG))
    kinds = [(f.kind, f.channel) for f in findings_of(ds)]
    assert ("truncated", "rig/angle 2") in kinds
    assert ("length", "psi1") in kinds
    assert ds.sizes["sample"] == 1500
    np.testing.assert_array_equal(ds["psi2"], b[:1500])
    assert not caplog.records  # said once, as a finding


def test_read_tdms__other_unit_is_a_finding(tmp_path, make):
    a, b = make.swing()
    path = tmp_path / "deg.tdms"
    waves = [{"wf_increment": 0.002, "unit_string": u} for u in ("Volts", "deg")]
    write_tdms(path, {"angle 1": a, "angle 2": b}, **{"angle 1": waves[0], "angle 2": waves[1]})
    volts = {"psi1": {"channel": "rig/angle 1", "unit": "V", "scale": 2.0}}
    mapping = parse_mapping({**RIG, "channels": {**RIG["channels"], **volts}})
    (found,) = findings_of(read_recording(path, mapping))
    assert (found.kind, found.channel) == ("unit", "psi2")
    assert "the file says 'deg', the mapping 'rad'" in found.text


# ---- MATLAB --------------------------------------------------------------------------------------


def test_read_matlab__vectors_rows_structures_and_cells(tmp_path, make):
    from scipy.io import savemat

    a, b = make.swing()
    cells = np.empty(2, object)
    cells[:] = [np.stack([a[:900], b[:900]]), np.stack([a[900:], b[900:]])]
    savemat(tmp_path / "x.mat", {"y": np.stack([a, b]), "column": a[:, None], "rig": {"angle": b}, "dt": 0.002})
    savemat(tmp_path / "cells.mat", {"y": cells, "dt": 0.002, "name": "text is no channel"})
    whole = read_raw(tmp_path / "x.mat")
    assert whole.names == ("y[0]", "y[1]", "column", "rig.angle")
    (channels,) = whole.stretches
    np.testing.assert_array_equal(channels["column"].values, a)
    np.testing.assert_array_equal(channels["rig.angle"].values, b)
    assert channels["y[1]"].step_s == 0.002
    mapping = {"model": "pendulum", "channels": {"psi1": {"channel": "y[0]"}, "psi2": {"channel": "y[1]"}}}
    ds = read_recording(tmp_path / "cells.mat", parse_mapping(mapping))
    assert np.bincount(ds["piece"]).tolist() == [900, 1100]
    np.testing.assert_array_equal(ds["psi2"], b)
    assert [f.kind for f in findings_of(ds)] == ["pieces"]


def test_read_matlab__structure_array_is_pieces(tmp_path, make):
    from scipy.io import savemat

    a, _ = make.swing()
    records = np.zeros((1, 3), dtype=[("angle", object), ("dt", object)])
    for i in range(3):
        records[0, i] = (a[400 * i : 400 * (i + 1)], 0.002)
    savemat(tmp_path / "s.mat", {"run": records})
    raw = read_raw(tmp_path / "s.mat")
    assert len(raw.stretches) == 3
    np.testing.assert_array_equal(raw.stretches[2]["run.angle"].values, a[800:1200])
    assert raw.stretches[0]["run.angle"].step_s == 0.002


def test_read_matlab__cells_that_differ_in_number_are_refused(tmp_path):
    from scipy.io import savemat

    def cells(n):
        made = np.empty(n, object)
        made[:] = [np.arange(5.0)] * n
        return made

    savemat(tmp_path / "c.mat", {"a": cells(2), "b": cells(3)})
    with pytest.raises(SpecError, match="a has 2, b has 3; save equally many"):
        read_raw(tmp_path / "c.mat")


# ---- LVM -----------------------------------------------------------------------------------------

LVM_MAPPING = {
    "model": "pendulum",
    "channels": {
        "psi1": {"channel": "Voltage_0", "unit": "V", "scale": 1.0},
        "psi2": {"channel": "Voltage_1", "unit": "V", "scale": 1.0},
    },
}


@pytest.mark.parametrize("columns", ["One", "Multi", "No"])
@pytest.mark.parametrize(("decimal", "n"), [(".", 300), (",", 300), (",", 100)])
def test_read_lvm__columns_decimal_commas_and_segments(tmp_path, make, columns, decimal, n):
    """One header, or one for every 100 samples as a program writes that appends what it has."""
    a, b = (v[:300] for v in make.swing())
    segments = [
        lvm_segment(a[i : i + n], b[i : i + n], columns=columns, time=f"12:00:{0.5 + 0.002 * i:09.6f}", comment="début")
        for i in range(0, 300, n)
    ]
    path = written_lvm(tmp_path / "x.lvm", segments, decimal=decimal, columns=columns)
    ds = read_recording(path, parse_mapping(LVM_MAPPING))
    assert findings_of(ds) == []
    assert not ds["piece"].any()
    assert ds.attrs["sampling_rate_hz"] == 500.0
    np.testing.assert_allclose(ds["time"], make.time[:300], atol=1e-9)
    np.testing.assert_allclose([ds["psi1"], ds["psi2"]], [a, b], atol=1e-12)


def test_read_lvm__gap_between_segments_is_a_finding(tmp_path, make):
    a, b = (v[:200] for v in make.swing())
    segments = [
        lvm_segment(a[:100], b[:100], columns="One", time="23:59:59.9"),
        lvm_segment(a[100:], b[100:], columns="One", time="23:59:59.9", x0=0.7),
    ]
    ds = read_recording(written_lvm(tmp_path / "x.lvm", segments), parse_mapping(LVM_MAPPING))
    (found,) = findings_of(ds)
    assert (found.kind, found.end_s) == ("gap", pytest.approx(0.7))
    assert np.bincount(ds["piece"]).tolist() == [100, 100]


def test_read_lvm__stamps_go_before_a_nominal_interval(tmp_path, make):
    """Software-timed samples: Delta_X is a wish, the X column says when."""
    a, b = (v[:100] for v in make.swing())
    segment = lvm_segment(a, b, columns="One", time="12:00:00", step=0.01, samples=1)
    segment = segment.replace("Delta_X\t0.010000\t0.010000", "Delta_X\t1.000000\t1.000000")
    ds = read_recording(written_lvm(tmp_path / "x.lvm", [segment], multi="No"), parse_mapping(LVM_MAPPING))
    assert ds.attrs["sampling_rate_hz"] == 100.0


def test_read_lvm__fewer_samples_than_stated_is_a_finding(tmp_path, make):
    a, b = (v[:90] for v in make.swing())
    segment = lvm_segment(a, b, columns="One", time="12:00:00", samples=100)
    ds = read_recording(written_lvm(tmp_path / "x.lvm", [segment]), parse_mapping(LVM_MAPPING))
    assert [(f.kind, f.channel) for f in findings_of(ds)] == [("truncated", "Voltage_0"), ("truncated", "Voltage_1")]
    assert "90 of the 100 samples" in findings_of(ds)[0].text


def test_read_lvm__special_blocks_and_empty_columns(tmp_path, make):
    a, b = (v[:50] for v in make.swing())
    segment = lvm_segment(a, b, columns="One", time="12:00:00")
    special = "***Start_Special***\t\nVendor\tanything\n***End_Special***\t\n\n"
    raw = read_raw(written_lvm(tmp_path / "x.lvm", [special, segment]))
    assert raw.names == ("Voltage_0", "Voltage_1")
    assert len(raw.stretches[0]["Voltage_1"]) == 50


@pytest.mark.parametrize("keep", [1, 5, 12, 13, 16, 22])
def test_read_lvm__broken_headers_are_refused(tmp_path, make, keep):
    a, b = (v[:50] for v in make.swing())
    path = written_lvm(tmp_path / "x.lvm", [lvm_segment(a, b, columns="One", time="12:00:00")])
    path.write_text("\n".join(path.read_text().splitlines()[:keep]))
    with pytest.raises(SpecError, match=r"x\.lvm: "):
        read_raw(path)


# ---- CSV -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("header", [True, False])
def test_read_csv__form_is_found_out(tmp_path, make, delimiter, decimal, header):
    if delimiter == decimal:
        return
    a, b = (v[:200] for v in make.swing())
    rows = [delimiter.join(f"{x:.9f}" for x in row).replace(".", decimal) for row in zip(a, b, make.time, strict=False)]
    head = [delimiter.join(["left", "right", "t"])] if header else []
    path = tmp_path / "x.csv"
    path.write_text("\n".join(head + rows) + "\n")
    raw = read_raw(path)
    assert raw.names == (("left", "right", "t") if header else ("1", "2", "3"))
    (channels,) = raw.stretches
    np.testing.assert_allclose(channels[raw.names[1]].values, b, atol=1e-9)


def test_read_csv__names_with_units_in_brackets_or_below(tmp_path):
    (tmp_path / "a.csv").write_text('"t [s]","angle (V)"\n0,1.5\n0.1,2.5\n')
    (tmp_path / "b.csv").write_text("Time;Channel A\n(ms);(V)\n\n0,0;1,5\n0,1;2,5\n")
    a, b = read_raw(tmp_path / "a.csv"), read_raw(tmp_path / "b.csv")
    assert [c.unit for c in a.stretches[0].values()] == ["s", "V"]
    assert b.names == ("Time", "Channel A")
    assert [c.unit for c in b.stretches[0].values()] == ["ms", "V"]
    np.testing.assert_array_equal(b.stretches[0]["Channel A"].values, [1.5, 2.5])


@pytest.mark.parametrize("stamp", ["2026-03-01 12:00:{:06.3f}", "2026/03/01T12:00:{:06.3f}", "12:00:{:06.3f}"])
def test_read_csv__dates_are_seconds_and_other_texts_are_left_out(tmp_path, make, stamp):
    a, _ = make.swing()
    rows = [f"{stamp.format(0.002 * i)};ok;{a[i]:.9f}".replace(".", ",") for i in range(500)]
    path = tmp_path / "x.csv"
    path.write_text("when;state;angle\n" + "\n".join(rows))
    assert read_raw(path).names == ("when", "angle")
    mapping = parse_mapping(
        {"model": "pendulum", "time": {"channel": "when"}, "channels": {"psi1": {"channel": "angle"}}}
    )
    ds = read_recording(path, mapping)
    assert ds.attrs["sampling_rate_hz"] == 500.0
    assert findings_of(ds) == []
    np.testing.assert_allclose(ds["psi1"], a[:500], atol=1e-9)


def test_read_csv__comma_that_may_be_both_can_be_stated(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("1,5\n2,5\n3,5\n")
    one = read_raw(path, csv=CsvMap(decimal=","))
    np.testing.assert_array_equal(one.stretches[0]["1"].values, [1.5, 2.5, 3.5])
    two = read_raw(path, csv=CsvMap(delimiter=",", decimal="."))
    np.testing.assert_array_equal(two.stretches[0]["2"].values, [5.0, 5.0, 5.0])


def test_read_csv__columns_of_unequal_length_and_holes(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("a,b\n1,1\n2,\n3,3\n4,\n5,\n")
    (channels,) = read_raw(path).stretches
    assert len(channels["a"]) == 5
    np.testing.assert_array_equal(channels["b"].values, [1.0, np.nan, 3.0])


def test_read_csv__truncated_last_row_is_a_finding(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("t,a,b\n0,1,2\n1,2,3\n2,3")
    raw = read_raw(path)
    assert [f.kind for f in raw.findings] == ["truncated"]
    assert len(raw.stretches[0]["t"]) == 2


def test_read_csv__comments_and_rows_before_the_names(tmp_path):
    path = tmp_path / "x.csv"
    path.write_text("Rig 3, run of Monday\nanything\n# comment\nt,a\n0,1\n1,2\n")
    raw = read_raw(path, csv=CsvMap(skip_rows=2))
    assert raw.names == ("t", "a")


# ---- all -----------------------------------------------------------------------------------------


HDF5 = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" ") + b"\x89HDF\r\n\x1a\n" + bytes(64)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        *(("x.tdms", c, r"x\.tdms: ") for c in (b"", b"TDSm", b"no TDMS file at all" * 10, b"TDSm" + bytes(40))),
        ("x.mat", HDF5, r"version 7\.3 \(HDF5\).*save\(FILE, '-v7'\)"),
        ("x.mat", b"not a MATLAB file " * 40, "save it with -v7"),
        ("x.lvm", b"t,a\n0,1\n", "is it a CSV file"),
        *(("x.csv", c, "is not a table of numbers") for c in (b"", b"\n\n", b"no numbers\nat all\n", b"a,b\n")),
        ("x.csv", b"1,5\n2,5\n3,5\n", "a comma may be between fields or in numbers"),
        ("x.tdms", None, "there is no such file"),
        ("x.bin", b"", r"the suffix '\.bin' is none of .* add format"),
    ],
)
def test_read_raw__what_is_none_is_refused(tmp_path, name, content, words):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(SpecError, match=words):
        read_raw(tmp_path / name)
