"""Limit cycles of flows: the return map, its derivative, periods and multipliers."""

import numpy as np
import pytest

from magpend_core import load_model, lyapunov_exponents
from magpend_core.crossing import Crossing
from magpend_core.models.sectioned import of_flow, sectioned
from magpend_core.orbits import orbit_exponents, section_map
from tests.core.cells import polish, run_cells, scipy_end
from tests.core.flows import HOPF, LORENZ, PAIR, ROSSLER, VAN_DER_POL, flow, table

VAN_DER_POL_PERIOD = 6.663286859323130
"""At mu = 1, to 30 digits 6.66328685932313018969968203053 (Amore, Boyd and Fernandez, arXiv:1707.02890)."""


def seen(table, of, **changes):
    """The parameters of a flow seen where a state crosses 0 upwards."""
    crossing = Crossing(of, longest=changes.pop("longest", 50.0), direction=changes.pop("direction", "up"))
    return sectioned(flow(table), crossing).load(**changes)


@pytest.mark.parametrize("mu", [0.01, 0.25, 1.0])
def test_polish_orbits__hopf_normal_form(mu):
    parameters = seen(HOPF, "y", mu=mu)
    found = polish(parameters, [[1.3 * np.sqrt(mu), 0.1 * mu]])
    assert found.converged.all()
    assert found.seconds[0] == pytest.approx(np.pi, rel=1e-11)  # 2 pi/omega
    np.testing.assert_allclose(found.section[0], [np.sqrt(mu), 0.0], atol=1e-11)
    # the other is 0 by construction: it stands for the flow's own
    np.testing.assert_allclose(found.multipliers[0], [np.exp(-2.0 * mu * np.pi), 0.0], atol=1e-10)
    assert found.is_stable[0]


def test_polish_orbits__least_number_of_returns():
    found = polish(seen(HOPF, "y"), [[0.6, 0.0]], period=6)
    assert found.orbit_period[0] == 1
    assert found.seconds[0] == pytest.approx(np.pi, rel=1e-11)


def test_polish_orbits__van_der_pol():
    found = polish(seen(VAN_DER_POL, "v", direction="down"), [[1.9, 0.0]])
    assert found.seconds[0] == pytest.approx(VAN_DER_POL_PERIOD, abs=1e-10)
    start = found.section[0]

    def rates(t, y):
        x, v, _ = y
        return [v, (1.0 - x**2) * v - x, 1.0 - x**2]

    # the product of all multipliers is the exponential of the divergence's integral (Liouville)
    end = scipy_end(rates, [*start, 0.0], found.seconds[0])
    np.testing.assert_allclose(end[:2], start, atol=1e-9)
    assert found.multipliers[0, 0].real == pytest.approx(np.exp(end[2]), rel=1e-8)
    assert found.multipliers[0, 0].imag == 0.0


@pytest.mark.slow
def test_polish_orbits__complex_multipliers():
    parameters = seen(PAIR, "y", mu=-0.1)
    found = polish(parameters, [[1.1, 0.0, 0.05, -0.02]])
    period = 2.0 * np.pi / 2.0
    pair = np.exp((-0.1 + 0.7j) * period)
    expected = [pair, pair.conj(), np.exp(-2.0 * period), 0.0]
    assert np.abs(found.multipliers[0][:, None] - expected).min(axis=1).max() < 1e-9


def test_polish_orbits__the_level_of_an_expression_as_a_state():
    """The normal form's cycle has the same period and multiplier where the section is x + y = 1/10."""
    define = {"x": "s - y + 0.1", "g": "mu - x**2 - y**2", "dx": "g*x - 2*y", "dy": "2*x + g*y"}
    slanted = table("slanted", {"s": "dx + dy", "y": "dy"}, {"mu": 0.25}, define=define, quantities={"x": "x"})
    found = polish(seen(slanted, "s"), [[0.0, -0.2]])
    assert found.seconds[0] == pytest.approx(np.pi, rel=1e-11)
    y = found.section[0, 1]
    assert (0.1 - y) ** 2 + y**2 == pytest.approx(0.25, rel=1e-11)
    np.testing.assert_allclose(found.multipliers[0], [np.exp(-0.5 * np.pi), 0.0], atol=1e-10)


@pytest.mark.slow
def test_polish_orbits__impacts_that_set_a_parameter_make_a_cycle():
    """x' = g (m - x) between -1 and 1, with m = 2 upwards and -2 downwards, has the period 2 ln(3)/g, and forgets m."""
    impacts = [
        {"of": "x - 1", "direction": "up", "set": {"m": "-2"}},
        {"of": "x + 1", "direction": "down", "set": {"m": "2"}},
    ]
    relay = table("relay", {"x": "g*(m - x)", "m": "0"}, {"g": 0.7}, impacts=impacts)
    found = polish(seen(relay, "x"), [[0.0, 1.8]])
    assert found.seconds[0] == pytest.approx(2.0 * np.log(3.0) / 0.7, rel=1e-11)
    np.testing.assert_allclose(found.section[0], [0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(found.multipliers[0], 0.0, atol=1e-12)
    assert found.is_stable[0]
    # where impacts add to m, each m gives a cycle of its own
    impacts[1]["set"] = {"m": "4 + m"}
    impacts[0]["set"] = {"m": "m - 4"}
    keeps = seen(table("keeps", relay["equations"], {"g": 0.7}, impacts=impacts), "x")
    found = polish(keeps, [[0.0, 2.3]])
    np.testing.assert_allclose(found.section[0], [0.0, 2.3], atol=1e-9)
    np.testing.assert_allclose(found.multipliers[0], [1.0, 0.0], atol=1e-9)


def test_section_map__differences():
    """On the section the derivative is that of the map, which differences of its images give."""
    parameters = seen(ROSSLER, "x", c=3.0)
    point = np.array([0.0, -4.0, 0.05])
    system, packed = parameters.model.system, parameters.pack()[None]
    rate = np.array([parameters.model.crossing.frequency_hz])
    found = section_map(packed, rate, point[None], 2, system=system)
    steps = 1e-5 * np.eye(3)[1:]
    around = np.concatenate([point + steps, point - steps])
    ends = section_map(np.tile(packed, (4, 1)), np.tile(rate, 4), around, 2, system=system).images[:, -1]
    np.testing.assert_allclose(found.derivatives[0, :, 1:], (ends[:2] - ends[2:]).T / 2e-5, atol=2e-7)
    assert (found.derivatives[0, 0] == 0.0).all()
    assert (found.derivatives[0, :, 0] == 0.0).all()
    np.testing.assert_allclose(found.images[0, :, 0], 0.0, atol=1e-12)


def test_section_map__no_return():
    """Where a trajectory does not come back there is no image."""
    parameters = seen(HOPF, "y", mu=-2.0, longest=0.5)
    found = section_map(
        parameters.pack()[None], np.array([2.0]), np.array([[0.5, 0.0]]), 1, system=parameters.model.system
    )
    assert np.isnan(found.images).all()
    assert np.isnan(found.derivatives).all()


def test_sectioned__same_object():
    model = flow(HOPF)
    one, other = sectioned(model, Crossing("y")), sectioned(model, Crossing("y"))
    assert one is other
    assert one.flow is model
    assert sectioned(model, Crossing("x")).digest != one.digest
    assert sectioned(model, Crossing("y", value=0.3)).load()["section_value"] == 0.3
    assert of_flow(one.load(mu=0.5)) == model.load(mu=0.5)
    with pytest.raises(ValueError, match="is forced"):
        sectioned(load_model("duffing"), Crossing("x"))


def exponents(parameters, starts, n_periods, tolerance=1e-8):
    n, system, hertz = len(starts), parameters.model.system, parameters.model.crossing.frequency_hz
    settled = run_cells(system, parameters.pack(), hertz, starts, n_transient=100, rtol=tolerance).section[:, 0, -1]
    options = {"n_transient": 50, "n_periods": n_periods, "rtol": tolerance, "atol": tolerance}
    return lyapunov_exponents(np.tile(parameters.pack(), (n, 1)), np.full(n, hertz), settled, system=system, **options)


@pytest.mark.slow
def test_lyapunov_exponents__limit_cycle():
    """Per second, though returns count the periods: 0 along the flow, and the logarithm of the multiplier."""
    parameters = seen(VAN_DER_POL, "v", direction="down")
    orbit = polish(parameters, [[1.9, 0.0]])
    found = exponents(parameters, [[1.0, 0.5]], 160)
    expected = np.log(orbit.multipliers[0, 0].real) / orbit.seconds[0]
    np.testing.assert_allclose(found.weighted[0], [0.0, expected], atol=2e-6)
    np.testing.assert_allclose(found.divergence[0], expected, atol=2e-6)
    own = orbit_exponents(orbit.multipliers[0], orbit.seconds[0], is_flow=True)
    np.testing.assert_allclose(own, [0.0, expected], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "of", "value", "start", "known", "error"),
    [
        # Sprott, Chaos and Time-Series Analysis, Oxford 2003, Sect. 4.8: 0.9056, 0, -14.5723
        (LORENZ, "z", 27.0, [1.0, 1.0, 20.0], [0.9056, 0.0, -14.5723], 0.004),
        # the same, for a = b = 0.2, c = 5.7: 0.0714, 0, -5.3943
        (ROSSLER, "x", 0.0, [0.0, -5.0, 0.05], [0.0714, 0.0, -5.3943], 0.002),
    ],
)
def test_lyapunov_exponents__published(table, of, value, start, known, error):
    parameters = sectioned(flow(table), Crossing(of, value, longest=50.0)).load()
    starts = np.array(start) + 0.1 * np.random.default_rng(0).normal(size=(16, 3))
    found = exponents(parameters, starts, 1600, 1e-10)
    mean = found.exponents.mean(axis=0)
    np.testing.assert_allclose(mean, known, atol=error)
    assert abs(mean[1]) < 5e-4
    np.testing.assert_allclose(found.exponents.sum(axis=1), found.divergence, atol=1e-4)
    if table is LORENZ:  # its divergence is the same everywhere
        np.testing.assert_allclose(found.divergence, -(10.0 + 1.0 + 8.0 / 3.0), rtol=1e-12)
