"""Each step of a spectrum by itself: windows, bins, lines, gaps and what is refused, against closed forms."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

import magpend
from magpend_core.models import load_model
from pipeline.analysis.spectrum.analysis import axes_of, needs_axis, needs_channel, spectrum_table
from pipeline.analysis.spectrum.declaration import SpectrumFigureOptions, SpectrumOptions, WaterfallOptions
from pipeline.analysis.spectrum.estimate import (
    LOBE,
    TWO_FREQUENCIES,
    _near,
    _peak,
    averaged,
    frequencies_of,
    pieces_of,
    power_unit,
)
from pipeline.analysis.spectrum.gaps import Settings, _fit, _weights, filled
from pipeline.analysis.spectrum.motions import _of_cell, clock_of, needs_motion, row_axis, settle_motion, swept_by
from pipeline.layout.vocabulary import BOUNDED_SET

TURN = 2.0 * np.pi


def run_of(name: str = "duffing", **dims: int) -> SimpleNamespace:
    """Return as much of a run as the choice of a motion asks for."""
    sizes = {"amplitude": 3, "initial_condition": 2, **dims}
    model = load_model(name)
    status = xr.Dataset({"status": ([*sizes], np.zeros([*sizes.values()], np.int8))})
    cube = status.assign_coords({d: np.arange(float(n)) for d, n in sizes.items() if d != "initial_condition"})
    return SimpleNamespace(model=model, cube=lambda: cube)


@pytest.mark.parametrize(("window", "bins"), [("boxcar", 1.0), ("hann", 1.5), ("flattop", 3.7702), ("hamming", 1.3628)])
def test_averaged__bandwidths_of_windows_are_published(window: str, bins: float) -> None:
    """Equivalent noise bandwidths in bins: Harris (Proc. IEEE 66, 51, 1978, table 1); Heinzel et al. (2002)."""
    found = averaged([np.random.default_rng(0).normal(size=2048)], 50.0, window=window, nperseg=1024, scaling="density")
    assert found.bandwidth_hz / found.resolution_hz == pytest.approx(bins, rel=1e-3)


def test_averaged__one_segment_keeps_the_variance() -> None:
    """Parseval: the integral of an unwindowed periodogram is the variance of its segment."""
    x = np.random.default_rng(1).normal(size=1000) + 7.0
    for scaling in ("density", "spectrum"):
        found = averaged([x], 3.0, window="boxcar", nperseg=1000, scaling=scaling)
        assert found.kept(scaling) == pytest.approx(1.0, rel=1e-12)
        assert found.variance == pytest.approx(x.var(), rel=1e-12)


def test_averaged__segments_of_all_pieces_have_equal_weight() -> None:
    rng = np.random.default_rng(2)
    long, short = rng.normal(size=1024), 3.0 * rng.normal(size=256)
    own = {"window": "hann", "nperseg": 256, "scaling": "density"}
    both, first, second = (averaged(p, 1.0, **own) for p in ([long, short], [long], [short]))
    assert (both.n_averages, first.n_averages, second.n_averages) == (8, 7, 1)
    np.testing.assert_allclose(both.power, (7.0 * first.power + second.power) / 8.0, rtol=1e-12)


def test_averaged__power_below_a_line_and_above_it() -> None:
    x = 2.0 * np.cos(TURN * 0.125 * np.arange(4096))
    for scaling in ("density", "spectrum"):
        found = averaged([x], 1.0, window="hann", nperseg=256, scaling=scaling)
        # the line is in bin 32, and a Hann window has three bins
        assert found.power_below(30, scaling) == pytest.approx(0.0, abs=1e-6)
        assert found.power_below(34, scaling) == pytest.approx(2.0, rel=1e-6)


def test_kept__of_a_constant_is_no_number() -> None:
    assert np.isnan(averaged([np.ones(64)], 1.0, window="hann", nperseg=32, scaling="density").kept("density"))


def test_near__lines_have_the_width_of_the_window() -> None:
    mask = _near(100, np.array([2.2, 50.0, 98.9, 99.6, 400.0]))
    assert np.flatnonzero(mask).tolist() == [
        *range(2 + LOBE + 1),
        *range(50 - LOBE, 50 + LOBE + 1),
        *range(99 - LOBE, 100),
    ]


@pytest.mark.parametrize("hertz", [0.731, 1.0, 2.34567])
def test_peak__lies_between_the_bins(hertz: float) -> None:
    n, rate = 4000, 20.0
    window = np.blackman(n)
    weighted = window * np.cos(TURN * hertz * np.arange(n) / rate + 0.4)
    power = np.abs(np.fft.rfft(weighted)) ** 2
    assert _peak(weighted, rate, power) == pytest.approx(hertz, abs=1e-7)


def test_frequencies_of__three_frequencies_are_not_explained_by_two() -> None:
    t = np.arange(40_000) / 20.0
    three = [0.4, 0.4 * (np.sqrt(5.0) - 1.0) / 2.0, 0.1 * np.e]
    whole = sum(np.cos(TURN * f * t) * (1.0 - 0.2 * k) for k, f in enumerate(three))
    found = frequencies_of(whole, 20.0)
    # lines of amplitudes 1, .8, .6: the third is left
    assert found.share == pytest.approx((1.0 + 0.64) / (1.0 + 0.64 + 0.36), abs=1e-3)
    assert found.share < TWO_FREQUENCIES


@pytest.mark.parametrize(
    ("unit", "scaling", "power"),
    [("m", "density", "m^2/Hz"), ("1", "spectrum", "1"), ("", "density", "1/Hz"), ("m/s", "spectrum", "(m/s)^2")],
)
def test_power_unit__of_channels(unit: str, scaling: str, power: str) -> None:
    assert power_unit(unit, scaling) == power


@pytest.mark.parametrize(("n", "half"), [(1, 2), (3, 3), (6, 6)])
def test_weights__are_exact_for_cubics(n: int, half: int) -> None:
    t = np.arange(n + 2.0 * half)
    cubic = 1.0 - t + 0.3 * t**2 - 0.02 * t**3
    beside = np.delete(cubic, np.s_[half : half + n])
    np.testing.assert_allclose(_weights(n, half) @ beside, cubic[half : half + n], atol=1e-9)
    np.testing.assert_allclose(_weights(n, half).sum(axis=1), 1.0)


def test_fit__meets_known_samples_or_is_none() -> None:
    t = np.arange(3000)
    assert _fit([np.random.default_rng(0).normal(size=3000)], 2, Settings()) is None
    swing = np.sin(TURN * t / 50.0)
    assert _fit([swing], 3, Settings()) is not None
    assert _fit([swing], 30, Settings()) is None  # more than half a turn
    assert _fit([swing[:4]], 2, Settings()) is None  # fewer samples than a window
    # a stricter bound on the error keeps shorter gaps only
    strict = Settings(error=1e-6)
    assert _fit([swing], 3, strict) is None


def test_filled__a_clock_that_started_anew_is_not_joined() -> None:
    swing = np.sin(TURN * np.arange(1000) / 50.0)
    parts = [swing[:500], swing[503:]]
    assert [len(p) for p in filled(parts, np.array([4.0])).pieces] == [1000]
    assert len(filled(parts, np.array([4.3])).pieces) == 2
    counted = filled([swing[:300], swing[301:600], swing[603:]], np.array([2.0, 4.0]))
    assert (counted.n_gaps, counted.n_samples, counted.longest) == (2, 4, 3)
    np.testing.assert_allclose(counted.pieces[0], swing, atol=1e-3)


def test_pieces_of__cuts_at_gaps_and_takes_the_rate_of_the_longest() -> None:
    time = np.round(np.arange(1000) / 30.0, 4)  # written with four digits
    ds = xr.Dataset({"x": ("time", np.arange(1000.0)), "y": ("time", np.zeros(1000))}, {"time": time})
    ds["x"][[100, 101, 500]] = np.nan
    channel, pieces, rate = pieces_of(ds, "")
    assert channel == "x"
    assert [len(p) for p in pieces] == [100, 398, 499]
    assert rate == pytest.approx(30.0, rel=1e-4)
    with pytest.raises(ValueError, match="'z' is not there; it has x, y"):
        pieces_of(ds, "z")
    ds["y"][::2] = np.nan
    with pytest.raises(ValueError, match="no two samples in a row"):
        pieces_of(ds, "y")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"channel": "y"}, "unknown channel 'y'"),
        ({"attractor": "?"}, "attractor '\\?': give its letter or its id"),
        ({"at": {"amplitude": 0.5}}, "amplitude = 0.5 is not on its axis"),
        ({"cell": 6}, "cell = 6 is out of bounds: the run has cells 0 to 5"),
        ({"cell": 0, "attractor": "A"}, "drop at and attractor"),
        ({"window": "round"}, "window 'round'"),
    ],
)
def test_needs_channel__refuses(options: dict[str, object], words: str) -> None:
    needs_channel(run_of(), SpectrumOptions())
    with pytest.raises(ValueError, match=words):
        needs_channel(run_of(), SpectrumOptions(**options))


def test_needs_axis__orders_need_a_drive_and_waterfalls_one_axis() -> None:
    needs_axis(run_of(), WaterfallOptions())
    with pytest.raises(ValueError, match="no drive whose multiples orders could be; take Hz"):
        needs_axis(run_of("lorenz"), SpectrumFigureOptions(axis="order"))
    with pytest.raises(ValueError, match="drawn along one axis, and none is left"):
        needs_axis(run_of(amplitude=1), WaterfallOptions())
    with pytest.raises(ValueError, match=r"2 are left \(amplitude, damping\)"):
        needs_axis(run_of(damping=2), WaterfallOptions())
    with pytest.raises(ValueError, match="spectra are drawn of one parameter point or one cell"):
        needs_axis(run_of(), SpectrumFigureOptions())


def test_settle_motion__letters_and_the_first_state() -> None:
    settled = [settle_motion(run_of(), SpectrumOptions(attractor=a)) for a in ("1", " b ", "")]
    assert [(one.channel, one.attractor) for one in settled] == [("x", "B"), ("x", "B"), ("x", "")]
    needs_motion(run_of(), settled[0])


def test_of_cell__goes_on_from_its_last_section() -> None:
    section = np.array([[0.1, 0.0], [0.2, 0.0], [np.nan, np.nan]])
    cell = xr.Dataset({"section": (("period_index", "state"), section), "status": ((), 1)})
    parameters = "\n".join(f"{k} = {v!r}" for k, v in load_model("duffing").load().items())
    found = xr.Dataset(coords={"frequency": 0.2}, attrs={"model": "duffing", "parameters": parameters})
    motion = _of_cell(found, cell, {"amplitude": 0.7})
    assert (motion.attractor, motion.kind, motion.period) == (-1, BOUNDED_SET, 0)
    assert motion.state.tolist() == [0.2, 0.0]
    assert motion.parameters["amplitude"] == 0.7
    assert clock_of(motion) == 0.2  # without a section the clock is that of the drive
    lost = cell.assign(section=cell["section"].where(cell["section"] > 1.0))
    with pytest.raises(ValueError, match="no section from which it could go on"):
        _of_cell(found, lost, {})


def test_row_axis__names_no_variable() -> None:
    assert [row_axis(name) for name in ("frequency", "F", "share")] == ["frequency", "F", "parameter_share"]
    assert [swept_by(name) for name in ("F", "parameter_share", "parameter_F")] == ["F", "share", "parameter_F"]


def test_spectrum_table__rows_are_bins_and_the_text_names_the_largest_lines() -> None:
    t = np.arange(4096) / 32.0
    x = np.cos(TURN * 4.0 * t) + 0.1 * np.cos(TURN * 10.0 * t)
    ds = xr.Dataset({"x": ("time", x, {"units": "m"})}, {"time": t})
    found = magpend.spectrum_of(ds, nperseg=512, scaling="spectrum", drive_hz=2.0)
    table = spectrum_table(found)
    assert len(table.rows) == 257
    assert table.rows[64]["frequency_hz"] == 4.0
    assert table.rows[64]["order"] == 2.0
    assert table.rows[64]["power"] == pytest.approx(0.5)
    assert table.lines[0] == "spectrum of x [m]"
    assert "0.5 at 2, 0.005 at 5" in "\n".join(table.lines)
    assert axes_of(found) == []
