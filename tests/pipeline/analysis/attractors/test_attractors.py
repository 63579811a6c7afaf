"""Attractors of the pendulum and of a driven pendulum whose orbits rotate, through the engine."""

import numpy as np
import pytest

from magpend_core import energy, load_preset, sections, trajectory
from magpend_core.models import load_model
from magpend_core.models.pendulum.sides import Side
from pipeline.layout.vocabulary import ATTRACTS, EXTENDED, PERIODIC_ORBIT
from tests.pipeline.analysis.cubes import ORBITS, STATES, attributes_of, cube_of, integrated
from tests.pipeline.analysis.dense_sets import identify, match

FREQUENCY = 2.2


@pytest.fixture(scope="session")
def starts():
    """64 states at rest, angles within 20 degrees."""
    states = np.zeros((64, 4))
    states[:, :2] = np.deg2rad(np.random.default_rng(22).uniform(-20, 20, (64, 2)))
    return states


@pytest.fixture(scope="session")
def cube(starts):
    result = sections(load_preset(), FREQUENCY, starts, n_transient=400, n_keep=32, rtol=1e-8)
    return cube_of(result, STATES, frequency=FREQUENCY)


@pytest.fixture(scope="session")
def found(cube):
    return identify(cube, parameters=load_preset())


def row_of(found, section):
    """The attractor with a point nearest to a section point."""
    distance = np.abs(found["attractor_points"].values - np.asarray(section)).max(axis=-1)
    return int(np.nanmin(distance, axis=-1).argmin())


@pytest.mark.slow
@pytest.mark.parametrize("orbit", [o for o in ORBITS if o["frequency_hz"] == FREQUENCY])
def test_identify__reference_orbits_from_random_starts(found, orbit):
    one = found.isel(attractor=row_of(found, orbit["section"]))
    assert one["kind"] == PERIODIC_ORBIT
    assert one["orbit_period"] == orbit["orbit_period"]
    assert np.abs(one["attractor_points"].values[0] - orbit["section"]).max() < 1e-9
    multipliers = one["multiplier_real"].values + 1j * one["multiplier_imag"].values
    expected = np.array([complex(*m) for m in orbit["multipliers"]])
    assert np.abs(multipliers[:, None] - expected).min(axis=0).max() < 1e-5
    assert one["residual"] < 1e-10
    assert one["stability"] == ATTRACTS
    assert one["n_cells"] > 5


@pytest.mark.slow
def test_identify__features_of_the_reference_orbits(found):
    right, left = (row_of(found, o["section"]) for o in ORBITS[:2])
    assert found["side"].values[[right, left]].tolist() == [Side.RIGHT, Side.LEFT]
    assert found["mirror_partner"].values[[right, left]].tolist() == [left, right]
    assert found["mirror_distance"].values[[right, left]].max() < 0.02  # duty cycle 0.4927
    assert not found["rotation"].values[[right, left]].any()
    # the ranges of mirror images are mirror images, and hold the section point
    low, high = found["state_min"].values, found["state_max"].values
    assert np.abs(low[right] + high[left]).max() < 0.15
    assert (low[right] <= np.array(ORBITS[0]["section"]) + 1e-9).all()
    assert (high[right] >= np.array(ORBITS[0]["section"]) - 1e-9).all()
    # over the full period, not at the sections alone
    assert (high[right, :2] - low[right, :2]).min() > 0.2
    assert (found["energy_max"] > found["energy_min"]).values[[right, left]].all()
    modulus = max(np.hypot(*m) for m in ORBITS[0]["multipliers"])
    assert found["lyapunov_max"].values[right] == pytest.approx(np.log(modulus) * FREQUENCY, rel=1e-5)
    right = row_of(found, ORBITS[0]["section"])
    times = np.linspace(0, 1 / FREQUENCY, 777)
    states = trajectory(load_preset(), FREQUENCY, np.array(ORBITS[0]["section"]), times)
    assert found["state_min"].values[right] == pytest.approx(states.min(axis=0), abs=2e-2)
    assert found["state_max"].values[right] == pytest.approx(states.max(axis=0), abs=2e-2)
    energies = energy(states, load_preset())
    assert found["energy_min"].values[right] == pytest.approx(energies.min(), abs=1e-3)
    assert found["energy_max"].values[right] == pytest.approx(energies.max(), abs=1e-3)


@pytest.mark.slow
def test_identify__every_cell_where_it_belongs(cube, found):
    ids = found["attractor_id"].values
    assert (ids >= 0).all()
    last = cube["section"].values[:, -1]
    for orbit in ORBITS[:2]:
        # modulus 0.96: what is within 0.01 after 400 periods has nowhere else to go
        near = np.abs((last - orbit["section"]) / [1, 1, 10, 10]).max(axis=1) < 0.01
        assert near.any()
        assert set(ids[near]) == {row_of(found, orbit["section"])}
    assert found["n_cells"].values.tolist() == np.bincount(ids).tolist()
    assert found["share"].values == pytest.approx(np.bincount(ids) / 64)
    named = match(found)
    assert same(found, named)
    assert named.attrs["matched"] == 1


@pytest.mark.slow
def test_identify__slow_spirals_stay_whole(starts, found):
    """Cells stopped at 1e-2 to 1e-5 from their orbits: the same two orbits, and no others beside them."""
    result = sections(load_preset(), FREQUENCY, starts, n_transient=180, n_keep=32, rtol=1e-8)
    early = identify(cube_of(result, STATES, frequency=FREQUENCY), parameters=load_preset())
    here = [row_of(early, o["section"]) for o in ORBITS[:2]]
    there = [row_of(found, o["section"]) for o in ORBITS[:2]]
    for a, b, orbit in zip(here, there, ORBITS, strict=False):
        assert np.abs(early["attractor_points"].values[a, 0] - orbit["section"]).max() < 1e-9
        cells = early["attractor_id"].values == a
        assert cells.sum() >= 5
        # those that were extended are chaotic: where they end is not where the straight run takes them
        cells &= early["decision"].values != EXTENDED
        assert (found["attractor_id"].values[cells] == b).all()
        assert (early["decision"].values[cells] > 1).any()
    periodic = early["orbit_period"].values[early["kind"].values == PERIODIC_ORBIT]
    assert (periodic == 1).sum() == 2


def same(a, b):
    """Equal to the last bit, the cells' variables aside."""
    own = [n for n in a.data_vars if "attractor" in a[n].dims]
    return len(own) > 10 and all(
        np.array_equal(a[n].values, b[n].values, equal_nan=a[n].dtype.kind == "f") for n in own
    )


@pytest.mark.slow
def test_identify__order_and_blocks_of_cells_do_not_matter(cube, found):
    order = np.random.default_rng(5).permutation(64)
    shuffled = identify(cube.isel(initial_condition=order), parameters=load_preset(), block_bytes=40_000)
    assert same(found, shuffled)
    assert np.array_equal(shuffled["attractor_id"].values, found["attractor_id"].values[order])
    assert np.array_equal(shuffled["decision"].values, found["decision"].values[order])


@pytest.mark.slow
def test_identify__parameters_from_the_run_and_its_axes(cube, found):
    """An axis replaces the attribute of the same name."""
    ds = cube.expand_dims(q=[load_preset()["q"]]).assign_attrs(attributes_of(load_preset(q=1.0)))
    result = identify(ds)
    assert same(found, result.isel(q=0))
    assert result["attractor_id"].dims == ("q", "initial_condition")
    with pytest.raises(ValueError, match="attribute 'parameters'"):
        identify(cube)
    with pytest.raises(ValueError, match="orbit_period"):
        identify(cube.drop_vars("orbit_period"))


# ---- a driven pendulum: th'' = -th'/2 - sin(th) + g cos(2 t/3) ---------------------------------


def test_identify__rotating_orbits_close():
    """At g = 1.4 the pendulum turns over once per drive period, one way or the other.

    Baker and Gollub, Chaotic Dynamics (1990), ch. 3: damping 1/2, drive frequency 2/3, phase-locked
    rotation between the chaotic ranges of g.
    """
    model, n, frequency = load_model("driven-pendulum"), 24, 2.0 / 3.0 / (2.0 * np.pi)
    parameters = model.load(d=0.5, A=1.4)
    starts = np.random.default_rng(1).uniform(-2, 2, (n, 2))
    result = integrated(parameters, frequency, starts, n_transient=100, n_keep=24)
    ds = cube_of(result, model.state_names, frequency=frequency)
    found = identify(ds, parameters=parameters.pack(), system=model.system)
    assert found["kind"].values.tolist() == [PERIODIC_ORBIT] * 2
    assert found["n_cells"].values.sum() == n
    period = found["orbit_period"].values
    # whole turns over the period, to the last digit
    assert np.sort(found["rotation"].values[:, 0]).tolist() == [-1.0, 1.0]
    # the divergence of the flow is minus the damping: the multipliers' product is known
    product = (found["multiplier_real"].values + 1j * found["multiplier_imag"].values).prod(axis=1)
    assert product == pytest.approx(np.exp(-0.5 * period / frequency), rel=1e-6)
    # the sign of the turns says which of the two a cell is on
    assert np.array_equal(
        np.sign(result.turns[:, 0, 0]), np.sign(found["rotation"].values[found["attractor_id"].values, 0])
    )
