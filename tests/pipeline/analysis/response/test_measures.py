"""Measures of sampled orbits, jumps and backbone tables, on sums of cosines and on results made by hand."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from pipeline.analysis.branches.kinds import KINDS as BIFURCATIONS
from pipeline.analysis.branches.problems import Value
from pipeline.analysis.response.analysis import _own_name, _ways, measured, measured_along
from pipeline.analysis.response.backbone import (
    KINDS,
    _at_ends,
    _cut_off,
    _scales_drive,
    _settled_force,
    _swing,
    backbone_table,
)
from pipeline.analysis.response.declaration import BackboneOptions
from pipeline.analysis.response.orbits import Measures, Orbit, _amplitude, _measure, harmonics_of, highest, lags_of
from pipeline.analysis.response.resonance import (
    ENDS,
    NEUTRAL,
    Curve,
    ModeProblem,
    ResonanceProblem,
    _is_within,
    mode_family,
    mode_start,
)
from pipeline.layout.conventions import code_flags
from pipeline.specification.problems import SpecError
from tests.core.flows import HOPF

TURN = 2.0 * np.pi
DUFFING = load_model("duffing").load(damping=0.2, linear=1.0, cubic=0.5, amplitude=0.4)
CRITICALITIES = ("none", "supercritical", "subcritical")


def waves(n: int, *parts: tuple[int, float, float]) -> np.ndarray:
    """Return samples of a sum of cosines (order, amplitude, lag) over a period, (orbit, sample, channel)."""
    t = TURN * np.arange(n) / n
    return sum(size * np.cos(order * t - lag) for order, size, lag in parts)[None, :, None]


def test_harmonics_of__a_sum_of_cosines() -> None:
    found = harmonics_of(waves(64, (1, 2.0, 0.3), (3, 0.5, -1.0)) + 7.0, 1, 4)[0, 0]
    np.testing.assert_allclose(np.abs(found), [2.0, 0.0, 0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(-np.angle(found[[0, 2]]), [0.3, -1.0], atol=1e-12)


def test_harmonics_of__a_subharmonic_are_those_of_the_drive() -> None:
    """Of an orbit over two drive periods the third line is the order 3/2; the drive's harmonics are lines 2 and 4."""
    found = harmonics_of(waves(128, (2, 1.0, 0.0), (3, 9.0, 0.0), (4, 0.25, 0.5)), 2, 2)[0, 0]
    np.testing.assert_allclose(np.abs(found), [1.0, 0.25], atol=1e-12)


@pytest.mark.parametrize("lag", [0.0, 0.01, 0.02, 0.04, 1.0])
def testhighest__lies_between_samples(lag: float) -> None:
    """A parabola through samples h apart, the nearest d beside the top of a cosine, misses it by d^2 (h^2 - d^2)/8."""
    h = TURN / 100
    d = lag - h * round(lag / h)
    assert highest(waves(100, (1, 1.0, lag)))[0, 0] == pytest.approx(1.0 - d**2 * (h**2 - d**2) / 8.0, abs=h**6)


def test_amplitude__is_half_of_peak_to_peak_also_of_a_constant() -> None:
    """cos t + .5 cos 2t has the largest value 1.5, and the least -.75 at cos t = -1/2."""
    found = _amplitude(waves(2000, (1, 1.0, 0.0), (2, 0.5, 0.0)))
    assert found.item() == pytest.approx(0.5 * (1.5 + 0.75), rel=1e-8)
    assert _amplitude(np.full((1, 64, 1), 4.0)).item() == 0.0


def test_measure__mean_rms_and_dominant_order() -> None:
    found = Measures(*np.full((3, 1, 1), np.nan), np.full((1, 1, 2), np.nan, complex), *np.full((2, 1, 1), np.nan))
    _measure(found, np.array([0]), 2.0 + waves(256, (2, 1.0, 0.2), (3, 4.0, 0.1)), 2, 2)
    assert found.mean.item() == pytest.approx(2.0)
    assert found.rms.item() == pytest.approx(np.sqrt(4.0 + 0.5 + 8.0))
    assert found.dominant.item() == 1.5
    assert found.error.item() < 1e-4


def test_measure__the_error_is_that_of_half_of_the_samples() -> None:
    """A line at the highest order of every second sample vanishes or folds there; of all samples it is seen."""
    found = Measures(*np.full((3, 1, 1), np.nan), np.full((1, 1, 1), np.nan, complex), *np.full((2, 1, 1), np.nan))
    _measure(found, np.array([0]), waves(64, (1, 1.0, 0.0), (31, 0.1, 0.0)), 1, 1)
    assert found.error.item() == pytest.approx(0.1, rel=0.05)


def test_measured__an_equilibrium_has_a_mean_and_nothing_else() -> None:
    """A flow at rest: no amplitude, no dominant line, and no phase."""
    cycle = load_model(HOPF).load()
    found = measured([Orbit(cycle, np.array([0.5, -0.25]), 1.0, 0)], cycle.model, 3)
    values = {name: np.asarray(variable[1])[0] for name, variable in found.items()}
    np.testing.assert_allclose(values["mean"], [0.5, -0.25])
    np.testing.assert_allclose(values["rms"], [0.5, 0.25])
    for name in ("amplitude", "dominant_order", "harmonic_amplitude"):
        np.testing.assert_allclose(values[name], 0.0, atol=1e-15)
    assert np.isnan(values["phase"]).all()


def test_measured_along__places_without_an_orbit_are_nan() -> None:
    cycle = load_model(HOPF).load()
    orbits = {(1, 2): Orbit(cycle, np.array([3.0, 4.0]), 1.0, 0)}
    found = measured_along(orbits, {"branch": 2, "point": 3}, cycle.model, 2)
    mean = np.asarray(found["mean"][1])
    assert found["mean"][0] == ("branch", "point", "channel")
    assert mean[1, 2].tolist() == [3.0, 4.0]
    assert np.isfinite(mean).sum() == 2
    none = measured_along({}, {"branch": 0, "point": 0}, cycle.model, 2)
    assert np.asarray(none["phase"][1]).shape == (0, 0, 2, 2)


def test_lags_of__a_flow_are_those_of_its_own_cosine() -> None:
    orbit = Orbit(load_model(HOPF).load(), np.zeros(2), 1.0, 1)
    harmonics = np.array([[[2.0 * np.exp(-0.4j), 1e-13, 0.5 * np.exp(1.2j)]]])
    found = lags_of([orbit], harmonics)[0, 0]
    np.testing.assert_allclose(found[[0, 2]], [0.4, -1.2])
    assert np.isnan(found[1])  # of no size, no phase


def test_orbit__of_period_two_takes_two_drive_periods() -> None:
    assert Orbit(DUFFING, np.zeros(2), 4.0, 2).frequency_hz == 0.5
    assert Orbit(DUFFING, np.zeros(2), 4.0, 2).is_driven
    assert not Orbit(load_model(HOPF).load(), np.zeros(2), 4.0, 1).is_driven
    assert Orbit(DUFFING, np.zeros(2), 4.0, 0).frequency_hz == 0.25


@pytest.mark.parametrize(
    ("kind", "criticality", "before", "after", "rises", "ways"),
    [
        ("fold", "none", 0, 1, True, [1]),  # the stable half ends as the parameter rises
        ("fold", "none", 1, 0, False, [-1]),
        ("fold", "none", 2, 1, True, []),  # neither half is stable
        ("period_doubling", "subcritical", 0, 1, True, [1]),
        ("period_doubling", "subcritical", 1, 0, True, [-1]),
        ("period_doubling", "supercritical", 0, 1, True, []),  # goes on to the doubled orbit
        ("neimark_sacker", "subcritical", 2, 2, True, []),
    ],
)
def test_ways__directions_in_which_stable_orbits_end(kind, criticality, before, after, rises, ways) -> None:
    located = xr.Dataset(
        {
            "kind": ("bifurcation", [BIFURCATIONS.index(kind)], code_flags(BIFURCATIONS)),
            "criticality": ("bifurcation", [CRITICALITIES.index(criticality)], code_flags(CRITICALITIES)),
            "n_unstable_before": ("bifurcation", [before]),
            "n_unstable_after": ("bifurcation", [after]),
            "rises_before": ("bifurcation", [int(rises)]),
        }
    )
    assert _ways(located, 0) == ways


def test_own_name__parameters_that_are_called_like_a_measure() -> None:
    assert [_own_name(name) for name in ("amplitude", "phase", "F")] == ["parameter_amplitude", "parameter_phase", "F"]


@pytest.mark.parametrize("channel", [0, 1])
def test_mode_start__at_the_largest_value_of_the_channel(channel: int) -> None:
    """Of x = Re(c exp(i w t)) with c = (1, 2i): x is largest at (1, 0), v at (0, 2)."""
    system = SimpleNamespace(scales=(1.0, 1.0))
    base = SimpleNamespace(model=SimpleNamespace(system=system))
    vector = np.exp(0.7j) * np.array([1.0, 2.0j])
    expected = [[1.0, 0.0], [0.0, 1.0]][channel]
    np.testing.assert_allclose(mode_start(base, vector, channel), expected, atol=1e-12)
    # a channel that takes no part, or a quantity: the state with the largest part
    np.testing.assert_allclose(mode_start(base, vector, 5), [0.0, 1.0], atol=1e-12)


def test_is_within__ends_count() -> None:
    bounds = ((0.0, 1.0), (2.0, 3.0))
    assert _is_within((0.0, 3.0), bounds)
    assert not _is_within((0.5, 3.1), bounds)
    assert not _is_within((np.nan, 2.5), bounds)


def test_curve__multipliers_of_a_normal_mode_are_without_those_of_flow_and_energy() -> None:
    problem = ModeProblem(mode_family(DUFFING, 0.2), DUFFING, np.zeros(2), ((0.1, 0.3), (0.0, 1.0)))
    matrix = np.diag([1.0 + 1e-9, np.exp(0.5), np.exp(-0.5), 1.0 - 1e-9])
    curve = Curve(problem, [], ("linear_mode", "bound"))

    def point_of(monodromy: np.ndarray) -> SimpleNamespace:
        value = Value(np.zeros(4), np.zeros((4, 5)), np.zeros((1, 4)), monodromy)
        return SimpleNamespace(value=value, u=np.zeros(3))

    point = point_of(matrix)
    np.testing.assert_allclose(sorted(curve.multipliers(point).real), [np.exp(-0.5), np.exp(0.5)])
    assert curve.n_unstable(point) == 1
    assert curve.kind == "normal_mode"
    point = point_of(np.diag([1.0, 1.0, 1.0 + 0.5 * NEUTRAL, 1.0 - 0.5 * NEUTRAL]))
    assert curve.n_unstable(point) == 0  # within the slack of a conservative system
    family = mode_family(DUFFING, 0.2)
    resonance = Curve(ResonanceProblem(family, DUFFING, 0, ()), [], ("bound", "bound"))
    assert (resonance.kind, resonance.n_unstable(point)) == ("phase_resonance", 1)


def test_scales_drive__only_the_amplitude_does() -> None:
    assert [name for name in DUFFING.names if _scales_drive(DUFFING, name, 0.2)] == ["amplitude"]
    swing = _swing(DUFFING, 0.2)
    # cos(w t) - 1 at the instants, in the rate of the velocity alone
    np.testing.assert_allclose(swing[:, :, 0], 0.0)
    expected = 0.4 * (np.cos(TURN * np.arange(16) / 16.0) - 1.0)
    np.testing.assert_allclose(swing[:, :, 1], np.broadcast_to(expected, (3, 16)), atol=1e-12)
    assert not _swing(DUFFING.replace(amplitude=0.0), 0.2).any()


def test_settled_force__bounds_and_refusals() -> None:
    found = _settled_force(DUFFING, BackboneOptions(), 0.2)
    assert found["drive"] == "amplitude"
    assert (found["drive_low"], found["drive_high"]) == pytest.approx((0.004, 0.8))
    for options, words in (
        ({"drive": "force"}, "unknown parameter 'force'"),
        ({"drive_low": 1.0}, "--drive-from 1 of amplitude: must be less than --drive-to 0.8"),
    ):
        with pytest.raises(SpecError, match=words):
            _settled_force(DUFFING, BackboneOptions(**options), 0.2)


def test_at_ends__swept_parameters_have_their_largest_value() -> None:
    axes = {"amplitude": SimpleNamespace(array=lambda: np.array([0.1, 0.3, 0.2]))}
    cube = xr.Dataset(coords={"amplitude": [0.1, 0.3, 0.2]})
    run = SimpleNamespace(spec=SimpleNamespace(axes=axes, continuation=None), cube=lambda: cube, model=DUFFING.model)
    assert _at_ends(run, DUFFING)["amplitude"] == 0.3
    assert _at_ends(run, DUFFING)["damping"] == 0.2


def backbones() -> xr.Dataset:
    """Return two curves: phase resonance of two points, and a normal mode of one."""
    nan = np.nan
    over, channel = ("curve", "point"), ("curve", "point", "channel")
    harmonic = (*channel, "harmonic")
    sizes = np.array([[[1.0, 2.0], [3.0, 4.0]], [[5.0, 6.0], [nan, nan]]])
    variables = {name: (channel, sizes) for name in ("amplitude", "mean", "rms", "error")}
    variables |= {name: (harmonic, sizes[..., None]) for name in ("harmonic_amplitude", "phase")}
    variables |= {
        "parameter": (over, [[0.16, 0.2], [0.3, nan]]),
        "force": (over, [[0.1, 0.4], [nan, nan]]),
        "residual": (over, np.zeros((2, 2))),
        "n_unstable": (over, [[0, 1], [0, -1]]),
        "multiplier_real": ((*over, "multiplier"), [[[0.3, 0.1], [1.5, 0.0]], [[0.0, nan], [nan, nan]]]),
        "multiplier_imag": ((*over, "multiplier"), [[[0.4, 0.0], [0.0, 0.0]], [[1.0, nan], [nan, nan]]]),
        "kind": ("curve", [0, 1], code_flags(KINDS)),
        "n_points": ("curve", [2, 1]),
        "first_end": ("curve", [ENDS.index("bound"), ENDS.index("linear_mode")], code_flags(ENDS)),
        "last_end": ("curve", [ENDS.index("stuck"), ENDS.index("bound")], code_flags(ENDS)),
    }
    coords = {"channel": ["x", "v"], "unit": ("channel", ["m", "m/s"]), "harmonic": [1]}
    attrs = {"parameter": "frequency_hz", "of_channel": "x", "force": "amplitude", "left_out": "a mode: decays"}
    return xr.Dataset(variables, coords, attrs)


def test_backbone_table__rows_of_points_and_lines_of_curves() -> None:
    table = backbone_table(backbones())
    assert [(r["curve"], r["kind"], r["channel"], r["amplitude"], r["stable"]) for r in table.rows] == [
        (0, "phase_resonance", "x", 1.0, True),
        (0, "phase_resonance", "v", 2.0, True),
        (0, "phase_resonance", "x", 3.0, False),
        (0, "phase_resonance", "v", 4.0, False),
        (1, "normal_mode", "x", 5.0, True),
        (1, "normal_mode", "v", 6.0, True),
    ]
    assert [r["largest_multiplier"] for r in table.rows[::2]] == pytest.approx([0.5, 1.5, 1.0])
    assert table.lines[0] == "amplitude of x [m] along its backbone curves"
    first = next(line for line in table.lines if "phase resonance" in line)
    assert "0.16 to 0.2" in first
    assert "50%" in first
    assert table.lines[-1].strip() == "a mode: decays"
    none = backbone_table(backbones().isel(curve=slice(0, 0)))
    assert none.lines == ["no backbone: a mode: decays"]


def test_cut_off__ends_that_are_no_ends_of_the_curve() -> None:
    problem = ModeProblem(mode_family(DUFFING, 0.2), DUFFING, np.zeros(2), ((0.1, 0.3), (0.0, 1.0)))
    points = [SimpleNamespace(u=np.array([0.0, 0.0, ratio])) for ratio in (1.0, 1.25)]
    curves = [Curve(problem, points, ("linear_mode", end)) for end in ("bound", "stuck", "max_points")]
    told = [list(_cut_off(curve, "frequency_hz")) for curve in curves]
    assert told[0] == []
    assert told[1][0].startswith("stuck at frequency_hz = 0.25:")
    assert next(_cut_off(curves[1], "period")).startswith("stuck at drive_period = 4:")
    assert told[2][0].startswith("2 points at frequency_hz = 0.25")
