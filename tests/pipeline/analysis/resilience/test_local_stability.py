"""Small disturbances, weighed basins and own quantities, against closed forms and matrix exponentials."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.special import ndtr

from pipeline.analysis.resilience.analysis import resilience_table
from pipeline.analysis.resilience.local import _growth, amplification_at_rest, amplification_of_orbit
from pipeline.runs.derive import AnalysedRun
from pipeline.specification.problems import SpecError
from tests.core.flows import HOPF, table
from tests.pipeline.analysis.cubes import line, sweep

FEW = {"directions": 8, "confirmations": 8, "phases": 1, "timed": 16}
NON_NORMAL = np.array([[-1.0, 10.0], [0.0, -2.0]])


def sizes_of(matrix, times):
    """The 2-norms of a matrix exponential."""
    return np.array([np.linalg.norm(expm(t * matrix), 2) for t in times])


def growth(matrix):
    """Largest eigenvalue of the symmetric part."""
    return np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[-1]


@pytest.mark.parametrize("matrix", [NON_NORMAL, np.diag([1e3, 1.0]) @ NON_NORMAL, [[-0.02, 3.0], [-0.5, -0.02]]])
def test_amplification_at_rest__matrix_exponential(matrix):
    """No time of a fine grid has a larger norm, and the norm at the time found is the one found."""
    matrix = np.asarray(matrix)
    found, at = amplification_at_rest(matrix)
    assert sizes_of(matrix, [at])[0] == pytest.approx(found, rel=1e-12)
    times = np.concatenate([np.geomspace(1e-6, 10.0, 400), np.linspace(0.0, 30.0, 400)])
    sizes = sizes_of(matrix, times)
    assert sizes.max() <= found * (1.0 + 1e-12)
    assert sizes.max() == pytest.approx(found, rel=2e-3)


def test_amplification_at_rest__none_and_never():
    """A normal matrix amplifies nothing (-I/2 is a test of Attractors.jl: 1 at time 0); a growing one is not known."""
    assert amplification_at_rest(-0.5 * np.eye(2)) == (1.0, 0.0)
    assert _growth(-0.5 * np.eye(2)[None]) == -0.5
    assert np.isnan(amplification_at_rest(np.diag([0.1, -1.0]))[0])


def test_amplification_of_orbit__products():
    """The largest of all products of consecutive steps, from every phase, also periods later."""
    rng = np.random.default_rng(1)
    for decay in (0.99, 0.7):
        steps = np.array([[[decay, 1.0], [0.0, 0.97 * decay]]] * 3) + 0.02 * rng.standard_normal((3, 2, 2))
        best, at = 1.0, 0
        for k in range(3):
            product = np.eye(2)
            for r in range(300):
                product = steps[(k + r) % 3] @ product
                if np.linalg.norm(product, 2) > best:
                    best, at = np.linalg.norm(product, 2), r + 1
        assert at > 0
        assert amplification_of_orbit(steps) == (pytest.approx(best, rel=1e-12), at)


@pytest.mark.slow
def test_resilience__local_stability_of_a_rest_in_scales(computed):
    """A = [[-1, 10], [0, -2]] with the scale 4 of y: the disturbances of x weigh four times as much."""
    states = {"y": {"scale": 4.0}}
    model = table("non_normal", {"x": "-x + 10*y", "y": "-2*y"}, states=states)
    starts = {"kind": "grid", "x": line(-1.0, 1.0, 4), "y": line(-1.0, 1.0, 4)}
    one = AnalysedRun.of(computed(sweep(model, starts, frequency_hz=1.0))).derive("resilience", **FEW).isel(set=0)
    scaled = np.array([[-1.0, 40.0], [0.0, -2.0]])
    assert float(one["reactivity"]) == pytest.approx(growth(scaled), rel=1e-9)
    # e^-t - e^-2t times 40 is the growth of y into x, largest at ln 2: 10, and a little less than the norm
    assert float(one["amplification"]) == pytest.approx(sizes_of(scaled, np.linspace(0.6, 0.8, 2001)).max(), rel=1e-7)
    assert float(one["amplification"]) > 10.0
    assert float(one["amplification_time"]) == pytest.approx(np.log(2.0), abs=0.02)
    assert float(one["return_time"]) == pytest.approx(1.0)
    assert one["reactivity"].attrs["units"] == "1/s"


@pytest.mark.slow
def test_resilience__local_stability_of_a_map(computed):
    """A linear map: powers of a matrix."""
    model = {**table("linear_map", {"x": "0.5*x + 4*y", "y": "0.75*y"}), "kind": "map"}
    starts = {"kind": "grid", "x": line(-1.0, 1.0, 3), "y": line(-1.0, 1.0, 3)}
    spec = sweep(model, starts)
    spec["integration"] = {"n_transient": 200, "n_keep": 8}
    one = AnalysedRun.of(computed(spec)).derive("resilience", **FEW).isel(set=0)
    matrix = np.array([[0.5, 4.0], [0.0, 0.75]])
    sizes = [np.linalg.norm(np.linalg.matrix_power(matrix, k), 2) for k in range(30)]
    assert float(one["reactivity"]) == pytest.approx(np.log(sizes[1]))
    assert float(one["amplification"]) == pytest.approx(max(sizes))
    assert float(one["amplification_time"]) == np.argmax(sizes)
    assert float(one["return_time"]) == pytest.approx(-1.0 / np.log(0.75))


@pytest.mark.slow
def test_resilience__local_stability_of_a_cycle(computed):
    """Turning with the cycle of Hopf's normal form, radius 1/2, the radius decays at 2 mu and the angle stays."""
    starts = {"kind": "grid", "x": line(-0.8, 0.9, 3), "y": line(-0.8, 0.9, 3)}
    found = AnalysedRun.of(computed(sweep(HOPF, starts, frequency_hz=1.0, lengths=(60, 8)))).derive("resilience", **FEW)
    assert found["return_time"].values == pytest.approx([2.0], rel=1e-6)
    assert found["reactivity"].values == pytest.approx([0.0], abs=1e-6)
    assert found["amplification"].values == pytest.approx([1.0], rel=1e-6)


# ---- weights and own quantities ----------------------------------------------------------------

WELLS_1D = sweep(
    table("double_well", {"x": "x - x**3 + 0*a"}, {"a": 1.0}),
    {"kind": "grid", "x": line(-3.0, 3.0, 400)},
    frequency_hz=1.0,
    lengths=(40, 4),
)
NORMAL = "exp(-(x - 0.3)**2/(2*0.5**2))"


@pytest.fixture(scope="module")
def double_well(computed):
    return AnalysedRun.of(computed(WELLS_1D))


@pytest.mark.slow
def test_resilience__weighed_by_a_normal_density(double_well):
    """Of x' = x - x^3 the share of x > 0 is the normal distribution's, and the mean of x^2 over it by quadrature."""
    found = double_well.derive("resilience", density=NORMAL, quantity="a*x**2 + 0*reactivity", **FEW)
    right = int(np.argmax(found["shock_from"].values[:, 0]))
    one = found.isel(set=right)
    exact = ndtr(0.3 / 0.5)
    assert float(one["basin_stability"]) == pytest.approx(0.5)
    assert float(one["weighted_stability"]) == pytest.approx(exact, abs=2e-5)
    assert float(one["weighted_stability_low"]) < exact < float(one["weighted_stability_high"])
    # (sum w)^2 / sum w^2 of a normal density is 2 sqrt(pi) sigma over the spacing
    assert float(one["n_effective"]) == pytest.approx(2.0 * np.sqrt(np.pi) * 0.5 / (6.0 / 399), rel=1e-6)
    x = np.linspace(0.0, 3.0, 100001)
    weight = np.exp(-((x - 0.3) ** 2) / 0.5)
    assert float(one["quantity"]) == pytest.approx((x**2 * weight).sum() / weight.sum(), abs=1e-3)
    assert float(one["return_time"]) == pytest.approx(0.5)
    assert float(one["reactivity"]) == pytest.approx(-2.0)
    assert found["weighted_stability"].values.sum() == pytest.approx(1.0)
    lines = "\n".join(resilience_table(found).lines)
    assert f"{float(one['weighted_stability']):.4f} (" in lines
    assert "quantity" in lines


@pytest.mark.slow
def test_resilience__weighs_arrivals_and_combines_results(double_well):
    """With all starts timed, a density of 1 on one half gives the mean time of that half; 1 changes nothing."""
    half = double_well.derive("resilience", density="where(x > 1.05, 2, 0)", within=1, **{**FEW, "timed": 400})
    plain = double_well.derive("resilience", quantity="shock_high*basin_stability + f", **{**FEW, "timed": 400})
    right = int(np.argmax(plain["shock_from"].values[:, 0]))
    # from x > 1 a trajectory is within .01 of 1 at exp(-2 t) (1 - 1/x^2) = 1 - 1/1.01^2
    x = np.linspace(-3.0, 3.0, 400)
    x = x[x > 1.05]
    entered = np.ceil(0.5 * np.log((1.0 - x**-2.0) / (1.0 - 1.01**-2.0)))
    assert float(half["weighted_time"][right]) == pytest.approx(entered.mean())
    assert float(half["weighted_stability"][right]) == 1.0
    assert np.isnan(half["weighted_time"][1 - right])
    assert half["weighted_arrived"].values[right] == pytest.approx(np.mean(entered <= 1))
    assert 0.0 < np.mean(entered <= 1) < 1.0
    assert plain["weighted_time"].values == pytest.approx(plain["mean_time"].values)
    assert plain["weighted_stability_low"].values == pytest.approx(plain["basin_stability_low"].values)
    assert float(plain["quantity"][right]) == pytest.approx(1.5, abs=1e-5)


@pytest.mark.slow
def test_resilience__numbers_of_attractors_jl(computed):
    """The "dumb map" of Attractors.jl: to (r, r) from x >= 0, to (-r, -r) from x < 0, and to 0 for r < 1/2.

    Expected values: test/nonlocal/stability_quantifiers_accumulator.jl of JuliaDynamics/Attractors.jl (commit 2973f2c),
    with finite time 0.5 on nine starts. Its mean time counts starts of other basins as 0.
    """
    to = "where(r < 0.5, 0, where(x >= 0, r, -r))"
    model = {**table("dumb_map", {"x": to, "y": to}, {"r": 1.0}), "kind": "map"}
    starts = {"kind": "grid", "x": line(-1.0, 1.0, 3), "y": line(-1.0, 1.0, 3)}
    spec = sweep(model, starts, axes={"r": {"values": [-1.0, 1.0]}})
    spec["integration"] = {"n_transient": 20, "n_keep": 4}
    run = AnalysedRun.of(computed(spec))
    options = {**FEW, "within": 0, "timed": 9, "largest": 4.0}
    found = run.derive("resilience", quantity="mean_time*basin_stability", **options)
    assert found["n_sets"].values.tolist() == [1, 2]
    order = [0, *(1 + np.argsort(found["shock_from"].values[1:, 0])).tolist()]  # 0, (-1, -1), (1, 1)
    expected = {
        "basin_stability": [1.0, 0.33333, 0.66667],
        "weighted_arrived": [0.11111, 0.11111, 0.11111],
        "arrived": [0.11111, 0.11111, 0.11111],
        "quantity": [0.88889, 0.22222, 0.55555],
        "longest_time": [1.0, 1.0, 1.0],
        "amplification": [1.0, 1.0, 1.0],
        "amplification_time": [0.0, 0.0, 0.0],
        "return_time": [0.0, 0.0, 0.0],
        # the boundary itself; the nearest starts beyond it, of which theirs are, are at 1 and 2
        "distance_high": [np.inf, 1.0, 1.0],
    }
    for name, values in expected.items():
        assert found[name].values[order] == pytest.approx(values, abs=1e-5), name
    # their mean non-critical shock
    to = "where(x >= 0, r, -r)"
    text = f"basin_stability*sqrt((x - {to})**2 + (y - {to})**2)"
    own = run.derive("resilience", quantity=text, **options)["quantity"].values[order]
    assert own[1:] == pytest.approx([0.33333, 0.85003], abs=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"density": "exp(-z)"}, "density = 'exp.-z.': unknown name 'z' at character 6"),
        ({"density": "x"}, "density = 'x': is -3 at x = -3; must be 0 or greater at all starts"),
        ({"density": "0*x"}, "density = '0.x': is 0 at all starts"),
        ({"quantity": "shock +"}, "quantity = 'shock .': "),
        ({"quantity": "shocks"}, "quantity = 'shocks': unknown name 'shocks'"),
    ],
)
def test_resilience__refuses_expressions(double_well, options, message):
    with pytest.raises(SpecError, match=message):
        double_well.derive("resilience", **options)
