"""Spectra against sums of sines, closed forms of stochastic processes, scipy, and known frequencies of tori."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy import signal
from scipy.integrate import solve_ivp

import magpend
from pipeline.analysis.series.analysis import series_table
from pipeline.analysis.spectrum.analysis import LINES, spectrum_table
from pipeline.analysis.spectrum.estimate import TWO_FREQUENCIES, frequencies_of
from pipeline.analysis.spectrum.figure import plot_spectrum
from pipeline.analysis.spectrum.gaps import filled
from pipeline.specification.problems import SpecError
from tests.pipeline.analysis.cubes import swept

TURN = 2.0 * np.pi


def series(values, rate_hz, **more):
    return xr.Dataset({"x": ("time", values, {"units": "m"}), **more}, {"time": np.arange(len(values)) / rate_hz})


def test_spectrum_of__sines_have_half_of_their_squared_amplitudes():
    t = np.arange(16_384) / 64.0
    x = 3.0 + 2.0 * np.cos(TURN * 5.0 * t + 0.3) + 0.01 * np.sin(TURN * 12.5 * t)
    found = magpend.spectrum_of(series(x, 64.0), nperseg=512, scaling="spectrum", drive_hz=2.5)
    power = found["power"].isel(spectrum=0).swap_dims(bin="frequency_hz")
    assert found["power"].attrs["units"] == "m^2"
    for hertz, amplitude in ((5.0, 2.0), (12.5, 0.01)):
        assert float(power.sel(frequency_hz=hertz)) == pytest.approx(amplitude**2 / 2, rel=1e-10)
        assert float(power["order"].sel(frequency_hz=hertz)) == pytest.approx(hertz / 2.5, rel=1e-12)
    assert float(found["kept"][0]) == pytest.approx(1.0, rel=1e-3)
    assert int(found["n_averages"][0]) == 63
    # of a Hann window: 1.5 bins
    assert float(found["bandwidth_hz"][0]) == pytest.approx(1.5 * float(found["resolution_hz"][0]))


def test_spectrum_of__an_ornstein_uhlenbeck_process_has_its_lorentzian():
    """dx = -g x dt + s dW, exactly discretised: one-sided density 2 s^2 / (g^2 + (2 pi f)^2), with its aliases."""
    rate, g, s, n = 200.0, 3.0, 0.7, 2**20
    decay = np.exp(-g / rate)
    kick = s * np.sqrt((1.0 - decay**2) / (2.0 * g))
    x, draws = np.zeros(n), np.random.default_rng(5).normal(size=n)
    x[0] = s / np.sqrt(2.0 * g) * draws[0]
    for i in range(1, n):
        x[i] = decay * x[i - 1] + kick * draws[i]
    found = magpend.spectrum_of(series(x, rate), nperseg=2048)
    f, power = found["frequency_hz"].values[0, 1:-1], found["power"].values[0, 1:-1]
    exact = 2.0 * kick**2 / rate / np.abs(1.0 - decay * np.exp(-1j * TURN * f / rate)) ** 2
    low = f < 5.0
    np.testing.assert_allclose(exact[low], 2.0 * s**2 / (g**2 + (TURN * f[low]) ** 2), rtol=0.01)  # hardly aliased
    blocks = (power / exact)[: len(f) // 32 * 32].reshape(-1, 32).mean(axis=1)
    # 1023 averages, half of them independent, times 32 bins
    assert np.abs(blocks - 1.0).max() < 5.0 / np.sqrt(512 * 32)
    # Parseval: the integral is the variance, but for half a bin at zero, which is the mean's
    fine = magpend.spectrum_of(series(x, rate), nperseg=2**15)
    at_zero = 2.0 * s**2 / g**2 * float(fine["resolution_hz"][0]) / 2.0
    assert float(fine["kept"][0]) == pytest.approx(1.0 - at_zero / x.var(), abs=4e-3)


def test_spectrum_of__pieces_and_gaps_are_averaged_apart_and_uneven_samples_are_refused():
    rng = np.random.default_rng(1)
    x = rng.normal(size=3000)
    x[1000] = np.nan
    ds = series(x, 10.0, piece=("time", np.repeat([0, 1], [2000, 1000])))
    found = magpend.spectrum_of(ds, nperseg=500)
    parts = [x[:1000], x[1001:2000], x[2000:]]
    # the pieces have 3, 2 and 3 segments
    own = [signal.welch(part, 10.0, nperseg=500)[1] for part in parts]
    np.testing.assert_allclose(found["power"].values[0], (3 * own[0] + 2 * own[1] + 3 * own[2]) / 8, rtol=1e-12)
    assert int(found["n_averages"][0]) == 3 + 2 + 3
    with pytest.raises(ValueError, match=r"nperseg = 1001.*1000 samples"):
        magpend.spectrum_of(ds, nperseg=1001)
    with pytest.raises(ValueError, match="even"):
        magpend.spectrum_of(ds.assign_coords(time=np.arange(3000) ** 1.1))


def swing_with_gaps(n, rate, gaps, *, hertz=0.8, noise=0.01):
    """A swing with noise, some stretches of it left out: from a sample on, so many samples."""
    t = np.arange(n) / rate
    x = np.cos(TURN * hertz * t) + noise * np.random.default_rng(2).normal(size=n)
    there = np.ones(n, bool)
    for first, length in gaps:
        there[first : first + length] = False
    piece = np.cumsum(np.diff(there.astype(int), prepend=1) > 0)
    ds = xr.Dataset({"x": ("time", x, {"units": "m"}), "piece": ("time", piece)}, {"time": t})
    return ds.isel(time=np.flatnonzero(there))


def largest_line(found):
    one = found.isel(spectrum=0)
    return float(one["frequency_hz"][int(one["power"].values.argmax())])


def test_spectrum_of__segments_are_as_long_as_the_stretches_between_gaps_allow():
    """A swing of 0.8 Hz in 13 stretches of 5 to 6 s: a sixteenth of a stretch is a third of its period."""
    ds = swing_with_gaps(16_000, 200.0, [(1250 * k, 190) for k in range(1, 13)])
    found = magpend.spectrum_of(ds)
    assert float(found["resolution_hz"][0]) == pytest.approx(200.0 * 16 / ds.sizes["time"], rel=0.01)
    assert largest_line(found) == pytest.approx(0.8, abs=float(found["resolution_hz"][0]) / 2)
    assert float(found["kept"][0]) > 0.95
    assert int(found["n_interpolated"][0]) == 0
    # an own choice that is too short is told
    short = magpend.spectrum_of(ds, nperseg=78)
    assert float(short["kept"][0]) < 0.9
    assert "warning: the bins hold" in short.attrs["notes"]
    assert "up to 1250 samples (nperseg)" in spectrum_table(short).lines[-1]


def test_spectrum_of__segments_are_lengthened_for_a_slow_motion():
    """Three periods in the whole series: a sixteenth has a fifth of one."""
    ds = swing_with_gaps(1600, 100.0, [], hertz=3.0 / 16.0)
    found = magpend.spectrum_of(ds)
    assert float(found["kept"][0]) > 0.9
    assert largest_line(found) == pytest.approx(3.0 / 16.0, abs=float(found["resolution_hz"][0]))
    assert found.attrs["notes"] == ""


def test_spectrum_of__short_gaps_are_interpolated_and_counted():
    gaps = [(700 * k, 1 + k % 3) for k in range(1, 20)]
    whole = magpend.spectrum_of(swing_with_gaps(16_000, 200.0, []))
    found = magpend.spectrum_of(swing_with_gaps(16_000, 200.0, gaps))
    assert int(found["n_interpolated"][0]) == sum(n for _, n in gaps)
    assert "38 samples in 19 short gaps were interpolated (at most 3 in a row)" in found.attrs["notes"]
    np.testing.assert_allclose(found["power"], whole["power"], atol=1e-4 * float(whole["power"].max()))
    # missing samples within a piece are such gaps as well
    holes = swing_with_gaps(16_000, 200.0, [])
    holes["x"][5000:5003] = np.nan
    assert int(magpend.spectrum_of(holes)["n_interpolated"][0]) == 3


def test_filled__neither_long_gaps_nor_leaps_are_interpolated():
    x = np.sin(0.05 * np.arange(2000))
    parts = [x[:900], x[905:1500], x[1560:] + 5.0]
    found = filled(parts, np.array([6.0, 61.0]))
    assert [len(p) for p in found.pieces] == [1500, 440]
    np.testing.assert_allclose(found.pieces[0], x[:1500], atol=1e-4)
    # half a turn is missing; a leap of the level; a clock that started anew; fewer samples than the fit needs
    for gap, leap, shift in ((63, 0.0, 0.0), (3, 1.0, 0.0), (3, 0.0, 0.4)):
        apart = filled([x[:900], x[900 + gap :] + leap], np.array([gap + 1.0 + shift]))
        assert (apart.n_gaps, apart.n_samples, len(apart.pieces)) == (0, 0, 2)
    assert filled([x[:900], x[903:904]], np.array([4.0])).n_gaps == 0


@pytest.mark.parametrize("drive", [None, 0.4])
def test_frequencies_of__a_torus_are_those_of_its_lines(drive):
    t = np.arange(60_000) / 20.0
    f1, f2 = 0.4, 0.4 * (np.sqrt(5.0) - 1.0) / 2.0
    x = 1.0 + np.cos(TURN * f1 * t) * (1.0 + 0.4 * np.cos(TURN * f2 * t)) + 0.6 * np.sin(TURN * f2 * t)
    found = frequencies_of(x, 20.0, drive)
    assert found.first_hz == pytest.approx(f1, abs=1e-9)
    assert found.second_hz == pytest.approx(f2, abs=1e-9)
    assert found.share > 1.0 - 1e-6
    third = frequencies_of(x + 0.5 * np.cos(TURN * 0.3 * np.sqrt(2.0) * t), 20.0, drive)
    assert third.share < TWO_FREQUENCIES


@pytest.fixture(scope="module")
def duffing(tmp_path_factory):
    """Sweep of the two-well oscillator: orbits of periods 1 and 2, chaos, and an orbit of period 2 about both wells."""
    model = magpend.model(
        "x'' = -0.3*x' + x - x**3 + F*cos(2*pi*f*t)", name="twowell", F=0.3, quantities={"power": "0.3*x_dot**2"}
    )
    spec = (
        magpend.Spec("sweep", model)
        .with_parameters(frequency_hz=1.2 / TURN)
        .with_axis("F", values=[0.2, 0.28, 0.5, 0.65])
        .with_start_list(points=[(1.0, 0.0), (0.1, 0.0)])
        .with_integration(n_transient=400, n_keep=64)
        .with_lyapunov(n_transient=50, n_periods=400)
    )
    return magpend.run(spec, tmp_path_factory.mktemp("runs") / "twowell", workers=0)


@pytest.mark.slow
def test_spectrum__lines_of_orbits_are_those_of_scipy(duffing):
    found = duffing.spectrum(orders=5)
    periods = found["orbit_period"].values
    lines = [i for i in range(found.sizes["spectrum"]) if int(found["estimate"][i]) == LINES]
    assert set(periods[lines]) == {1, 2}
    for i in lines:
        force, p = float(found["F"][i]), int(periods[i])

        def rates(t, y, force=force):
            return [y[1], -0.3 * y[1] + y[0] - y[0] ** 3 + force * np.cos(1.2 * t)]

        start = duffing.attractors().magpend.sets()
        own = (start["attractor_id"] == found["attractor"][i]) & (start["F"] == force)
        first = int(start["n_points"].values[: int(np.flatnonzero(own)[0])].sum())
        state = start["attractor_points"].values[first]
        t = np.linspace(0.0, p * TURN / 1.2, 2048 * p, endpoint=False)
        x = solve_ivp(rates, (0.0, t[-1]), state, t_eval=t, method="DOP853", rtol=1e-12, atol=1e-12).y[0]
        exact = np.abs(2.0 * np.fft.rfft(x) / len(x))[1 : 5 * p + 1]
        np.testing.assert_allclose(found["amplitude"].values[i, : 5 * p], exact, atol=1e-8)
        np.testing.assert_allclose(found["order"].values[i, : 5 * p], np.arange(1, 5 * p + 1) / p, rtol=1e-9)
        assert float(found["variance"][i]) == pytest.approx(x.var(), rel=1e-8)
        assert float(found["kept"][i]) == pytest.approx(0.5 * (exact**2).sum() / x.var(), rel=1e-8)


@pytest.mark.slow
def test_spectrum__of_chaos_is_a_density_whose_integral_is_the_variance(duffing):
    found = duffing.spectrum(at={"F": 0.5}, channel="x_dot")
    (chaos,) = [i for i in range(found.sizes["spectrum"]) if int(found["estimate"][i]) != LINES]
    one = found.isel(spectrum=chaos)
    assert int(one["n_averages"]) == 31
    assert float(one["resolution_hz"]) == pytest.approx(1.2 / TURN / 64)

    def rates(t, y):
        return [y[1], -0.3 * y[1] + y[0] - y[0] ** 3 + 0.5 * np.cos(1.2 * t)]

    t = np.arange(32_000) * TURN / 1.2 / 32
    v = solve_ivp(rates, (0.0, t[-1]), [0.1, 0.0], t_eval=t, rtol=1e-8, atol=1e-8).y[1][3200:]
    # chaotic trajectories differ: their statistics agree to the error of some hundred periods
    assert float(one["variance"]) == pytest.approx(v.var(), rel=0.1)
    kept = float(one["power"].sum()) * float(one["resolution_hz"])
    assert kept == pytest.approx(float(one["variance"]), rel=0.03)
    # the line of the drive, in a density a^2 / 2 over the window's bandwidth
    line = np.abs(2.0 * np.mean(v * np.exp(-1.2j * t[3200:])))
    at = float(one["power"].isel(bin=64)) * float(one["bandwidth_hz"])
    assert at == pytest.approx(line**2 / 2.0, rel=0.15)


@pytest.mark.slow
def test_spectrum__of_a_cell_is_that_of_its_attractor(duffing):
    ids = duffing.attractors()["attractor_id"]
    number = int(np.ravel_multi_index((3, 1), ids.shape))
    found = duffing.spectrum(cell=number)
    assert found["attractor"].values.tolist() == [int(ids[3, 1])]
    assert float(found["F"][0]) == 0.65
    same = duffing.spectrum(at={"F": 0.65}, attractor=str(int(ids[3, 1])))
    xr.testing.assert_equal(found.drop_attrs(), same.drop_attrs())


@pytest.mark.slow
def test_spectrum__of_a_torus_has_the_frequencies_of_its_uncoupled_oscillators(tmp_path):
    """A cycle r = 1 of rate w beside a driven linear oscillator z of known amplitude; their product has f +- f2."""
    f, f2 = 0.3, 0.1 * np.sqrt(2.0)
    model = magpend.model(
        "x' = x*(1 - x**2 - y**2) - w*y\ny' = y*(1 - x**2 - y**2) + w*x\nz'' = -0.5*z' - z + cos(2*pi*f*t)",
        name="uncoupled",
        w=TURN * f2,
        quantities={"both": "x + z + 0.2*x*z"},
    )
    starts = [(0.9, 0.0, 0.1, 0.0), (0.0, 1.2, 0.0, 0.3)]
    run = swept(model, tmp_path / "run", starts, (300, 128), parameters={"frequency_hz": f})
    found = run.spectrum(channel="both", scaling="spectrum", segment=200)
    assert spectrum_table(found).rows[0]["kind"] == "torus"
    one = found.isel(spectrum=0)
    assert float(one["first_hz"]) == f
    assert float(one["second_hz"]) == pytest.approx(f2, rel=1e-8)
    assert float(one["explained"]) > 0.9999
    a = 1.0 / abs(1.0 - (TURN * f) ** 2 + 0.5j * TURN * f)
    power, frequency = one["power"].values, one["frequency_hz"].values
    # the power of a line between two bins: that of its lobe over the bandwidth
    width = float(one["resolution_hz"] / one["bandwidth_hz"])
    for hertz, amplitude in ((f, a), (f2, 1.0), (f + f2, 0.1 * a), (f - f2, 0.1 * a)):
        lobe = np.abs(frequency - hertz) < 4.0 * float(one["resolution_hz"])
        assert power[lobe].sum() * width == pytest.approx(amplitude**2 / 2.0, rel=1e-3)
    (ax,) = run.plot.spectrum(channel="both")
    assert "f_2" in ax.get_title(loc="left")
    assert f"{f2:.6g} Hz" in ax.get_title(loc="left")
    names = {text.get_text() for text in ax.texts}
    assert {"$f$", "$f_2$", "$f+f_2$"} <= names <= {"$f$", "$f_2$", "$f+f_2$", "$f-f_2$"}


@pytest.mark.slow
def test_series__of_a_chaotic_cell_has_the_exponent_of_its_tangents(duffing):
    """From the samples of the cell's motion alone, and from the variational equations (``[products] lyapunov``)."""
    # shorter series of this motion, and those of x, are not decided
    cell = {"cell": 4, "channel": "x_dot", "periods": 150, "samples": 36}
    found = duffing.series(**cell)
    exponent = found.sel(quantity="exponent")
    known = float(duffing.cube()["lyapunov"].isel(exponent=0).values.ravel()[4])
    assert found.attrs["motion"] == "chaotic"
    assert 0.0 < float(exponent["low"]) <= known <= float(exponent["high"])
    assert float(found["F"]) == 0.5
    assert "chaotic" in series_table(found).lines[0]
    assert len(duffing.plot.series(**cell)) == 6
    with pytest.raises(SpecError, match="of one motion, and"):
        duffing.series()
    with pytest.raises(SpecError, match="unknown channel 'w'"):
        duffing.series(channel="w")


@pytest.mark.slow
def test_spectrum__of_a_flow_is_in_hertz(tmp_path):
    """Cycles x = r cos(2 t) of r^2 = (1 + sqrt(1 + 4 mu)) / 2: one line at 1/pi Hz."""
    model = magpend.model(
        "x' = x*g - 2*y\ny' = y*g + 2*x\ng = mu + x**2 + y**2 - (x**2 + y**2)**2", name="cycles", mu=0.1
    )
    run = swept(model, tmp_path / "run", [(1.0, 0.0)], (200, 4), section=("y", "up"), mu=[-0.4, 0.1, 0.2])
    found = run.spectrum()
    assert "order" not in found.coords
    closed = found["orbit_period"].values == 1
    mu = found["mu"].values[closed]
    np.testing.assert_allclose(found["amplitude"].values[closed, 0], np.sqrt(0.5 + np.sqrt(0.25 + mu)), rtol=1e-8)
    np.testing.assert_allclose(found["frequency_hz"].values[closed, 0], 1.0 / np.pi, rtol=1e-8)
    np.testing.assert_allclose(found["amplitude"].values[closed, 1:], 0.0, atol=1e-8)
    assert not np.nan_to_num(found["amplitude"].values[~closed]).any()  # at rest
    with pytest.raises(SpecError, match="no drive"):
        run.plot.waterfall(axis="order")
    ax = run.plot.waterfall()
    assert ax.get_ylabel() == "frequency [Hz]"


@pytest.mark.slow
def test_figures__show_lines_densities_and_orders(duffing):
    (panel,) = duffing.plot.spectrum(at={"F": 0.5})
    assert panel.get_xlabel().startswith("order")
    assert "31 averages, resolution 0.0156 orders" in panel.get_title(loc="left")
    ax = duffing.plot.waterfall(axis="Hz")
    (mesh,) = [c for c in ax.collections if c.get_gid() == "waterfall"]
    # at F = .2 only lines: colour at the drive's frequency, none beside it
    column = np.ma.filled(mesh.get_array().reshape(720, 4)[:, 0], np.nan)
    y = (np.arange(720) + 0.5) * ax.get_ylim()[1] / 720
    drive = int(np.abs(y - 1.2 / TURN).argmin())
    first = duffing.spectrum(at={"F": 0.2})
    assert np.nanmax(column[drive - 1 : drive + 2]) == pytest.approx(float(first["amplitude"][0, 0]), rel=1e-9)
    assert np.isnan(column[drive + 20])


def test_figure__ends_where_the_power_does():
    """A line of order 1 and a trace of order 3: the axis does not go on to the highest bin, at order 12.8."""
    t = np.arange(16_384) / 64.0
    for trace, last in ((1e-9, (2.0, 2.2)), (0.1, (3.0, 3.2))):
        x = np.cos(TURN * 2.5 * t) + trace * np.cos(TURN * 7.5 * t)
        found = magpend.spectrum_of(series(x, 64.0), nperseg=512, drive_hz=2.5)
        ax = plot_spectrum(found).axes[0]
        assert float(found["order"].max()) > 12.0
        assert last[0] < ax.get_xlim()[1] < last[1]


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"channel": "y"}, "'y'"),
        ({"window": "tall"}, "window 'tall'"),
        ({"cell": 8}, "cells 0 to 7"),
        ({"cell": 1, "at": {"F": 0.2}}, "drop at"),
        ({"attractor": "Z"}, "no set Z"),
    ],
)
@pytest.mark.slow
def test_spectrum__wrong_options_are_refused(duffing, options, named):
    with pytest.raises(SpecError, match=named):
        duffing.spectrum(**options)


@pytest.mark.slow
def test_spectra__along_omega_stay_in_hertz_and_orders(tmp_path):
    """x'' + .2 x' + x = cos(omega t): one line at omega / 2 pi, of the amplitude in closed form."""
    run = swept("x'' = cos(omega*t) - 0.2*x' - x", tmp_path / "run", [(0.0, 0.0)], (200, 4), omega=[0.5, 1.0, 2.0])
    omega = np.array([0.5, 1.0, 2.0])
    found = run.spectrum(channel="x_dot")
    np.testing.assert_allclose(found["frequency_hz"][:, 0], omega / TURN, rtol=1e-12)
    exact = omega / np.abs(1.0 - omega**2 + 0.2j * omega)
    np.testing.assert_allclose(found["amplitude"][:, 0], exact, rtol=1e-9)
    np.testing.assert_allclose(found["amplitude"][:, 1:], 0.0, atol=1e-9)
    table = run.table("spectrum", channel="x_dot")
    first = table[table["order"].round(9) == 1.0]
    np.testing.assert_allclose(first["omega"], omega, rtol=1e-12)
    np.testing.assert_allclose(first["frequency_hz"], omega / TURN, rtol=1e-12)
    assert "omega" in run.plot.waterfall().get_xlabel()
    (panel,) = run.plot.spectrum(at={"omega": 2.0}, axis="Hz")
    assert panel.get_xlabel() == "frequency [Hz]"
    assert panel.collections[0].get_segments()[0][0, 0] == pytest.approx(2.0 / TURN)
