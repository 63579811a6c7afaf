"""The product ``lyapunov``: stored beside the sections, the same as computed directly, flagged."""

import tomllib

import numpy as np
import pytest

from magpend_core import LyapunovExponents, Status, load_preset, lyapunov_exponents, polish_orbits
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from pipeline import open_run
from pipeline.compute.exponents import flags
from pipeline.layout.plan import make_plan
from pipeline.products.lyapunov import LyapunovFlag
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from tests.pipeline.factories import finished

SPEC = """
kind = "sweep"

[axes]
frequency_hz = { values = [1.0, 2.2] }

[initial_conditions]
kind = "list"
points = [[-0.05, -0.1, -2.76, 3.65], [0.3, -0.2]]

[integration]
n_transient = 300
n_keep = 4
max_steps_per_period = 400
closure_tolerance = 1e-4

[products]
lyapunov = { n_transient = 100, n_periods = 160, n_blocks = 4 }
"""


@pytest.fixture(scope="module")
def cube(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lyapunov")
    return open_run(finished(folder, SPEC)).load()


@pytest.mark.slow
def test_lyapunov__is_what_the_core_gives_from_the_last_section(cube):
    packed = load_preset().pack()
    for frequency in (1.0, 2.2):
        one = cube.sel(frequency=frequency)
        rows = np.flatnonzero(one.status == Status.BOUNDED)
        found = lyapunov_exponents(
            np.tile(packed, (len(rows), 1)),
            np.full(len(rows), frequency),
            one.section.isel(period_index=-1).values[rows],
            n_transient=100,
            n_periods=160,
            n_blocks=4,
            max_steps_per_period=400,
            system=PENDULUM_FITTED,
        )
        assert (one.lyapunov.values[rows] == found.exponents).all()
        assert (one.lyapunov_stderr.values[rows] == found.stderr).all()
        assert (one.lyapunov_blocks.values[rows] == found.blocks).all()
        assert (one.divergence.values[rows] == found.divergence).all()
    assert (cube.sel(frequency=1.0).status == Status.BOUNDED).all()
    assert (cube.lyapunov.sel(frequency=1.0, exponent=1) > 1.0).all()


def test_lyapunov__of_a_closed_orbit_is_that_of_its_multipliers(cube):
    closed = cube.sel(frequency=2.2).isel(initial_condition=0)
    assert closed.status == Status.PERIODIC
    orbit = polish_orbits(
        load_preset().pack()[None],
        np.array([2.2]),
        closed.section.values[-1:],
        closed.orbit_period.values[None],
        system=PENDULUM_FITTED,
    )
    expected = np.log(np.abs(orbit.multipliers[0])) * 2.2
    # 160 periods: the weighted average is at 1e-4 with the default of 400
    assert closed.lyapunov.values == pytest.approx(expected, abs=5e-3)
    assert closed.lyapunov_flag == LyapunovFlag.GOOD


def test_lyapunov__failed_cells_have_none(tmp_path):
    spec = SPEC.replace("max_steps_per_period = 400", "max_steps_per_period = 20")
    found = open_run(finished(tmp_path, spec)).load()
    assert (found.status == Status.STEP_LIMIT).all()
    assert (found.lyapunov_flag == LyapunovFlag.ABSENT).all()
    assert np.isnan(found.lyapunov).all()


def test_lyapunov__without_the_product_there_is_no_variable():
    plan, whole = (make_plan(Spec.parse(tomllib.loads(text))) for text in (SPEC[: SPEC.index("[products]")], SPEC))
    assert "lyapunov" not in [v.name for v in plan.variables]
    # 260 more periods at twice the cost of the 304
    assert whole.core_seconds / plan.core_seconds == pytest.approx(1.0 + 2.0 * 260 / 304)
    assert whole.n_bytes - plan.n_bytes == 4 * 8 * (4 + 4 + 16 + 1) + 4


def made_up(**changes):
    values = {
        "exponents": np.tile([0.5, 0.0, -0.2, -1.0], (2, 1)),
        "stderr": np.zeros((2, 4)),
        "weighted": np.zeros((2, 4)),
        "blocks": np.zeros((2, 4, 4)),
        "divergence": np.full(2, -0.7),
        "loss": np.full(2, 1e3),
        "status": np.full(2, Status.BOUNDED, np.int8),
        "is_whole": True,
    }
    return LyapunovExponents(**{**values, **changes})


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, LyapunovFlag.GOOD),
        ({"divergence": np.array([-0.7, -0.71])}, LyapunovFlag.GOOD),  # 0.6 % of 1.7
        ({"divergence": np.array([-0.7, -0.72])}, LyapunovFlag.AUDIT_FAILED),
        ({"divergence": np.array([-0.7, -0.68])}, LyapunovFlag.AUDIT_FAILED),
        ({"loss": np.array([1.0, 1e15])}, LyapunovFlag.UNRESOLVED),
        ({"status": np.array([2, Status.DIVERGED], np.int8)}, LyapunovFlag.FAILED),
        # a whole spectrum is held against the divergence, whatever its length, and a part of it is not
        ({"exponents": np.tile([0.1, -0.3], (2, 1)), "divergence": np.array([-0.2, -0.3])}, LyapunovFlag.AUDIT_FAILED),
        ({"exponents": np.tile([0.5], (2, 1)), "is_whole": False}, LyapunovFlag.GOOD),
    ],
)
def test_flags__say_what_is_wrong(changes, expected):
    assert flags(made_up(**changes)).tolist() == [LyapunovFlag.GOOD, expected]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("n_blocks = 4", "n_blocks = 1", r"products.lyapunov.n_blocks = 1: must be at least 2"),
        ("{ n_transient = 100,", "{ n_exponents = 5,", r"products.lyapunov.n_exponents = 5: must be at most 4"),
        ("{ n_transient = 100,", "{ n_transients = 20,", r"n_transients: unknown key; did you mean n_transient"),
        ("lyapunov = {", "liapunov = {", r"products.liapunov: unknown key; did you mean lyapunov"),
    ],
)
def test_products__mistakes_are_named(old, new, words):
    assert old in SPEC
    with pytest.raises(SpecError, match=words):
        Spec.parse(tomllib.loads(SPEC.replace(old, new)))
