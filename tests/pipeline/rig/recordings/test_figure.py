"""The figure of a recording shows its samples, its pieces and its findings; the tables count them."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.rig.recordings import recording_of, smooth
from pipeline.rig.recordings.figure import MOST_DOTS, plot_recording
from pipeline.rig.recordings.overview import describe_file, describe_recording


def line_of(figure, name):
    (line,) = [x for ax in figure.axes for x in ax.lines if x.get_gid() == f"recording-{name}"]
    return line


@pytest.fixture
def broken(make):
    """Two pieces, samples that are none, and a drive."""
    a, b = make.swing()
    a[100:120] = np.nan
    stamps = make.time + 0.5 * (make.time > 2.0)
    mapping = make.mapping(tables={"time": {"channel": "t"}, "drive": {"channel": "m", "kind": "torque"}})
    columns = {"t": stamps, "a": a, "b": b, "m": np.cos(3.0 * make.time)}
    return recording_of(make.raw(make.channels(columns, step_s=np.nan)), mapping)


@pytest.mark.slow
def test_plot_recording__shows_samples_pieces_and_findings(broken):
    figure = plot_recording(broken)
    drawn = line_of(figure, "psi2").get_ydata()
    np.testing.assert_array_equal(drawn[np.isfinite(drawn)], broken["psi2"])
    assert np.isnan(drawn).sum() == 1  # the gap
    assert figure.data is broken
    assert [t.get_text() for legend in figure.legends for t in legend.get_texts()][-2:] == ["gap", "missing"]
    assert line_of(plot_recording(smooth(broken)), "psi1_dot").get_ydata().size


def test_plot_recording__long_recordings_keep_their_extremes(make):
    n = 50_000
    a, b = make.swing(n)
    a[33_333] = 9.0
    figure = plot_recording(make.recorded(a, b))
    drawn = line_of(figure, "psi1").get_ydata()
    assert drawn.max() == 9.0
    assert drawn.min() == a.min()
    assert len(drawn) <= 1.1 * MOST_DOTS


def test_describe_recording__counts(broken):
    quantities, findings = describe_recording(broken)
    rows = {row["quantity"]: row for row in quantities.rows}
    assert rows["psi1"]["not_measured"] == 20
    assert rows["psi2"]["greatest"] == float(broken["psi2"].max())
    assert np.isnan(rows["drive"]["noise"])
    assert [row["kind"] for row in findings.rows] == ["gap", "missing"]
    assert "3.998" not in quantities.lines[0]
    assert "in 2 pieces" in quantities.lines[0]


def test_describe_file__lists_stretches_and_empty_fields(make):
    a, b = make.swing()
    a[3] = np.nan
    halves = [make.channels({"a": a[s], "b": b[s]}) for s in (slice(0, 800), slice(800, None))]
    table = describe_file(make.raw(*halves))
    assert table.lines[0].endswith("2 channels in 2 stretches")
    assert table.rows[0]["no_numbers"] == 1
    assert table.rows[1]["samples"] == 2000
    assert table.rows[1]["sampling_rate_hz"] == 500.0
