"""What stored exponents say, and how they are drawn."""

import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from magpend_core import Status, load_preset, lyapunov_exponents
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from pipeline.analysis.chaos.lyapunov import CellMotion, spectrum_of_jacobians, summarise
from pipeline.analysis.chaos.lyapunov_figure import plot_lyapunov, plot_lyapunov_map
from tests.core.cells import stroboscopic_map
from tests.pipeline.analysis.cubes import artists, exponents_cube
from tests.pipeline.analysis.maps import henon, slopes_of

FREQUENCY = np.array([1.0, 2.0, 4.0])


@pytest.fixture
def cube():
    return exponents_cube([[1.0, 0.2], [0.01, -0.3], [0.9, 0.8]], frequency=FREQUENCY, initial_condition=[0, 1])


def test_summarise__per_period_running_drift_and_audit(cube):
    found = summarise(cube)
    assert found.lyapunov_per_period.dims == cube.lyapunov.dims
    assert found.lyapunov_per_period.values[:, 0, 0] == pytest.approx([1.0, 0.005, 0.225])
    assert found.lyapunov_per_period_stderr.values[:, 0, 0] == pytest.approx([0.02, 0.01, 0.005])
    running = summarise(cube).lyapunov_running
    assert running.isel(block=-1).values == pytest.approx(cube.lyapunov.values)
    assert running.values[0, 0, 0, 0] == pytest.approx(1.05)
    assert running.values[0, 0, 2, 0] == pytest.approx(1.0 + 0.05 / 3)
    blocks = cube["lyapunov_blocks"].copy()
    blocks[0, 0, 4:, 0] -= 1.2
    found = summarise(cube.assign(lyapunov_blocks=blocks))
    assert found.drift.values[0, 0] == pytest.approx(-1.2)
    # blocks scatter by 0.05, four on either side: sample variance 0.0025 * 4/3
    assert found.drift_sigma.values[0, 0] == pytest.approx(-1.2 / np.sqrt(2 * 0.0025 * 4 / 3 / 4))
    assert abs(found.drift_sigma.values[1, 0]) < 1e-9
    assert summarise(cube).audit.values == pytest.approx(-0.001)
    assert np.isnan(summarise(cube.isel(exponent=slice(2))).audit).all()
    with pytest.raises(ValueError, match=r"no Lyapunov exponents; run it with \[products\]"):
        summarise(cube.drop_vars("lyapunov"))


def test_summarise__motion(cube):
    cube["status"][2, 1] = Status.PERIODIC
    cube["lyapunov_flag"][0, 1] = 4
    cube["status"][1, 0] = Status.PERIODIC
    summary = summarise(cube)
    found = summary.motion.values
    # 1.0 and 0.6 are both positive; 0.01 is within three errors, which is regular where the orbit closed; a
    # cell that closed with a positive exponent is not
    assert summary.contradicts.values.tolist() == [[0, 0], [0, 0], [0, 1]]
    assert found.tolist() == [
        [CellMotion.HYPERCHAOTIC, CellMotion.UNKNOWN],
        [CellMotion.REGULAR, CellMotion.REGULAR],
        [CellMotion.HYPERCHAOTIC, CellMotion.UNDECIDED],
    ]
    assert summarise(cube.isel(exponent=slice(1))).motion.values[0, 0] == CellMotion.CHAOTIC
    cube["lyapunov_flag"][0, 0] = 3  # only the first exponent is resolved
    assert summarise(cube).motion.values[0, 0] == CellMotion.CHAOTIC


@pytest.mark.slow
def test_spectrum_of_jacobians__henon():
    # a = 1.4, b = 0.3: l1 = 0.419 (0.4192), l1 + l2 = ln 0.3
    n_transient = 50
    jacobians = slopes_of(henon(100, n_transient + 4096, n_transient=0))
    found = spectrum_of_jacobians(jacobians, n_transient=n_transient)
    assert found.exponents[:, 0].mean() == pytest.approx(0.419, abs=0.001)
    assert found.exponents.sum(axis=1) == pytest.approx(np.log(0.3), abs=1e-12)
    # the errors of the trajectories are what they scatter by
    assert found.exponents[:, 0].std(ddof=1) == pytest.approx(found.stderr[:, 0].mean(), rel=0.25)
    alone = spectrum_of_jacobians(jacobians[3], n_transient=n_transient)
    assert alone.exponents == pytest.approx(found.exponents[3], abs=1e-13)
    assert alone.blocks.mean(axis=0) == pytest.approx(alone.exponents)
    assert alone.blocks.shape == (16, 2)


def test_spectrum_of_jacobians__falling_order_and_singular_maps():
    # the basis stays where it began: in rising order
    found = spectrum_of_jacobians(np.tile(np.diag([0.5, 2.0]), (8, 1, 1)), n_blocks=2)
    assert found.exponents == pytest.approx(np.log([2.0, 0.5]))
    assert found.stderr == pytest.approx(0.0)
    flat = spectrum_of_jacobians(np.tile(np.diag([2.0, 0.0]), (8, 1, 1)), n_blocks=2)
    assert flat.exponents.tolist() == [pytest.approx(np.log(2.0)), -np.inf]


@pytest.mark.parametrize(
    ("shape", "options", "message"),
    [
        ((8, 2), {}, "give .*n, state, state"),
        ((8, 2, 3), {}, "give .*n, state, state"),
        ((20, 2, 2), {}, "20 Jacobians after the transient .* give 16"),
        ((20, 2, 2), {"n_transient": 5}, "15 Jacobians"),
        ((16, 2, 2), {"n_blocks": 1}, "n_blocks = 1, n_transient = 0: give 2 or more"),
    ],
)
def test_spectrum_of_jacobians__mistakes(shape, options, message):
    with pytest.raises(ValueError, match=message):
        spectrum_of_jacobians(np.ones(shape), **options)
    with pytest.raises(ValueError, match="not all finite"):
        spectrum_of_jacobians(np.full((16, 2, 2), np.nan))


@pytest.mark.slow
def test_spectrum_of_jacobians__is_the_spectrum_of_the_engine():
    # few periods: chaos separates the two computations
    start, one, frequency = np.array([[0.5, -0.3, 0.0, 0.0]]), load_preset().pack()[None], np.array([2.4])
    jacobians, point = [], start
    for _ in range(26):
        image, derivative = stroboscopic_map(one, frequency, point, 1, rtol=1e-11)
        jacobians.append(derivative[0])
        point = image[:, -1]
    expected = spectrum_of_jacobians(jacobians, n_blocks=4, n_transient=10)
    found = lyapunov_exponents(
        one, frequency, start, n_transient=10, n_periods=16, rtol=1e-11, atol=1e-11, n_blocks=4, system=PENDULUM_FITTED
    )
    assert found.exponents[0] == pytest.approx(expected.exponents * 2.4, abs=1e-4)
    assert found.blocks[0] == pytest.approx(expected.blocks * 2.4, abs=1e-4)
    assert found.stderr[0] == pytest.approx(expected.stderr * 2.4, abs=1e-4)


@pytest.mark.slow
def test_plot_lyapunov__points_are_the_largest_exponents_with_their_errors(cube):
    cube["lyapunov"][0, 1, 0] = 0.97
    cube["lyapunov_flag"][1, 1] = 2
    fig = plot_lyapunov(cube)
    (line,), (flagged,) = artists(fig, "exponent:2"), artists(fig, "flagged:exponent:2")  # right: psi1 = psi2 = 0.3
    drawn = [*zip(line.get_xdata(), line.get_ydata(), strict=True)]
    assert (flagged.get_xdata().tolist(), flagged.get_ydata().tolist()) == ([2.0], pytest.approx([-0.3]))
    expected = sorted((f, v) for f, row in zip(FREQUENCY, cube.lyapunov.values[..., 0], strict=True) for v in row)
    expected.remove((2.0, -0.3))
    assert np.array(sorted(drawn)) == pytest.approx(np.array(expected))
    # bands are one error wide; those of 1.0 and 0.97 overlap
    (band,) = [a for a in artists(fig, "band:exponent:2") if isinstance(a, PolyCollection)]
    assert (0.95, 1.02) in {
        (round(p.vertices[:, 1].min(), 9), round(p.vertices[:, 1].max(), 9)) for p in band.get_paths()
    }


@pytest.mark.slow
def test_plot_lyapunov_map__the_largest_over_the_cells(cube):
    rates = np.array([[[0.5, -0.1], [-0.2, -0.3]], [[0.1, 0.7], [np.nan, np.nan]]])
    plane = exponents_cube(rates, frequency=[1.0, 2.0], q=[1.0, 1.5], initial_condition=[0, 1])
    fig = plot_lyapunov_map(plane)
    (mesh,) = artists(fig, "map")
    expected = np.array([[0.5, 0.7], [-0.2, np.nan]])  # rows q, columns frequency
    assert np.ma.filled(mesh.get_array(), np.nan) == pytest.approx(expected, nan_ok=True)
    assert fig.data["chaotic_share"].values.tolist() == [[0.5, 1.0], [0.0, 0.0]]
    per_period = plot_lyapunov_map(plane, per="period").data["exponent_value"].values
    assert per_period == pytest.approx(expected / np.array([1.0, 2.0]), nan_ok=True)
    with pytest.raises(ValueError, match="unknown unit"):
        plot_lyapunov(cube, per="second")
    with pytest.raises(ValueError, match=r"two swept parameters, and 1 are left \(frequency\)"):
        plot_lyapunov_map(cube)
    two = exponents_cube(np.zeros((2, 2)), frequency=[1.0, 2.0], q=[1.0, 1.5])
    with pytest.raises(ValueError, match="choose a value first"):
        plot_lyapunov(two)
    assert plot_lyapunov(two, at={"q": 1.5}).data["exponent_value"].sizes == {"frequency": 2, "exponent": 1}
