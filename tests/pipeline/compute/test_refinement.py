"""Refined grids: the logic of the boxes on known labels, a Duffing oscillator, and whole runs."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magpend_core import Status
from magpend_core.models import load_model
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from magpend_core.sections import run_branches
from pipeline import open_run
from pipeline.compute.refinement import NO_ORBIT, SAME_ORBIT_CLOSURES, Orbits, infer, refine
from pipeline.compute.task import compute
from pipeline.layout import plan as planning
from pipeline.layout.plan import make_plan
from pipeline.layout.schema import REFINEMENT, base_variables
from pipeline.runs.status import state
from pipeline.specification.problems import SpecError
from pipeline.specification.spec import Spec
from tests.pipeline.factories import quietly

VARIABLES = base_variables(load_model())

RUN = """
kind = "sweep"
[axes]
frequency_hz = { values = [2.8, 2.9] }
[initial_conditions]
kind = "grid"
refine = 4
psi1 = { start = 0.10, stop = 0.104, num = 17 }
psi2 = { start = 0.20, stop = 0.204, num = 18 }
[integration]
rtol = 1e-5
atol = 1e-5
n_transient = 300
n_keep = 6
stop_when_closed = true
closure_tolerance = 1e-2
max_orbit_period = 4
[execution]
trajectories_per_task = 64
"""


# ---- boxes -------------------------------------------------------------------------------------


def refined(labels, stride):
    """Sources of a field of labels; checks that each cell is asked for once, in rising order."""
    asked = np.zeros(labels.size, int)

    def classes_of(cells):
        assert (np.diff(cells) > 0).all()
        asked[cells] += 1
        return labels.ravel()[cells]

    source = refine(labels.shape, stride, classes_of)
    own = source == np.arange(labels.size).reshape(labels.shape)
    assert (asked == own.ravel()).all()
    assert own.ravel()[source.ravel()].all()
    return source, own


@pytest.mark.slow
@given(
    st.integers(1, 3).flatmap(lambda d: st.lists(st.integers(1, 40 // d**2 + 4), min_size=d, max_size=d)),
    st.sampled_from([2, 4, 8, 16]),
    st.integers(0, 2**32 - 1),
)
def test_refine__half_spaces_give_the_full_grid(shape, stride, seed):
    rng = np.random.default_rng(seed)
    grid = np.stack(np.indices(shape), axis=-1)
    normal = rng.normal(size=len(shape))
    labels = ((grid - rng.uniform(0, shape)) @ normal > 0).astype(int)
    source, _ = refined(labels, stride)
    # convex basins: a box with all corners in one lies in it
    assert (labels.ravel()[source] == labels).all()


@pytest.mark.parametrize(
    ("shape", "stride", "largest"), [((257,), 16, 0.13), ((129, 129), 8, 0.30), ((33, 33, 33), 8, 0.67)]
)
def test_refine__ball_takes_the_cells_near_its_surface(shape, stride, largest):
    grid = np.stack(np.indices(shape), axis=-1)
    centre, radius = 0.47 * np.array(shape), 0.31 * shape[0]
    distance = np.linalg.norm(grid - centre, axis=-1)
    labels = (distance < radius).astype(int)
    source, own = refined(labels, stride)
    assert (labels.ravel()[source] == labels).all()
    assert own.mean() < largest
    assert own[np.abs(distance - radius) < 1.0].all()


@pytest.mark.parametrize("labels", [np.full((9, 9), NO_ORBIT), np.random.default_rng(1).integers(0, 2, (64, 64))])
def test_refine__nothing_stands_for_what_is_no_orbit_or_random(labels):
    _, own = refined(labels, 4)
    assert own.all()


def test_refine__one_basin_takes_the_lattice_alone():
    source, own = refined(np.zeros((17, 22), int), 8)
    first, second = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
    assert (first.tolist(), second.tolist(), own.sum()) == ([0, 8, 16], [0, 8, 16, 21], 12)
    assert (source[5, 7], source[8, 21], source[9, 20]) == (0, 8 * 22 + 21, 8 * 22 + 16)


def test_refine__neighbours_open_a_box_again():
    # a tongue that enters the middle box between its corners, from a boundary found on the left
    labels = np.zeros((17, 33), int)
    labels[:, :4] = 1
    labels[4:6, :14] = 1
    source, _ = refined(labels, 8)
    assert (labels.ravel()[source] == labels).all()


def test_refine__an_island_between_the_lattice_is_not_seen():
    labels = np.zeros((17, 17), int)
    labels[3:6, 3:6] = 1
    source, own = refined(labels, 8)
    assert own.sum() == 9
    assert (labels.ravel()[source] == 0).all()


# ---- orbits ------------------------------------------------------------------------------------


def test_orbits__cyclic_sets_on_the_circle_with_turns():
    a, b = [3.1, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    wrapped = [-3.1, 0.0, 0.0, 0.0]  # 0.083 from `a` on the circle
    rows = [
        ([b, a, b], 2, [0, 0], 1),
        ([a, b, a], 2, [0, 0], 1),
        ([b, wrapped, b], 2, [0, 0], 1),
        ([b, a, b], 2, [1, 0], 1),
        ([b, b, b], 1, [0, 0], 1),
        ([b, a, b], 2, [0, 0], 2),
        ([b, a, b], 4, [0, 0], 1),
        ([a, a, [1.0, 0.0, 0.9, 0.0]], 1, [0, 0], 1),
        ([b, b, [1.0, 0.0, 1.1, 0.0]], 1, [0, 0], 1),
    ]
    cells = {
        "section": np.array([r[0] for r in rows]),
        "orbit_period": np.array([r[1] for r in rows], np.int16),
        "turns": np.array([r[2] for r in rows], np.int32),
        "status": np.array([r[3] for r in rows], np.int8),
    }
    orbits = Orbits(0.1, PENDULUM_FITTED)
    # rates count in units of 10 rad/s: 0.9 is within the tolerance, 1.1 is not
    assert orbits.classes(cells).tolist() == [0, 0, 0, 1, 2, NO_ORBIT, NO_ORBIT, 2, 3]
    again = {name: array[::-1] for name, array in cells.items()}
    assert orbits.classes(again).tolist() == [3, 2, NO_ORBIT, NO_ORBIT, 2, 1, 0, 0, 0]


# ---- Duffing oscillator ------------------------------------------------------------------------


TOLERANCE, DUFFING = 1e-4, load_model("duffing").system


def two_wells(n):
    """Function that integrates cells of an n x n grid of the Duffing oscillator by their flat indices."""
    x = np.linspace(-2.0, 2.0, n)
    starts = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)

    def integrate(cells):
        result = run_branches(
            np.broadcast_to([0.25, -1.0, 1.0, 0.08], (len(cells), 1, 4)),
            np.full((len(cells), 1), 0.2),
            starts[cells],
            n_transient=200,
            n_keep=4,
            rtol=1e-6,
            atol=1e-6,
            stop_when_closed=True,
            closure_tolerance=TOLERANCE,
            max_orbit_period=4,
            system=DUFFING,
        )
        return {v.name: getattr(result, v.name)[:, 0] for v in VARIABLES}

    return integrate


@pytest.mark.slow
def test_infer__duffing_against_the_full_grid():
    n = 96
    integrate, asked = two_wells(n), []

    def counted(cells):
        asked.extend(cells)
        return integrate(cells)

    full = integrate(np.arange(n * n))
    found = infer((n, n), 8, counted, closure_tolerance=TOLERANCE, system=DUFFING)
    orbits = Orbits(SAME_ORBIT_CLOSURES * TOLERANCE, DUFFING)
    labels = orbits.classes(full)
    assert set(np.unique(labels)) == {0, 1}
    inferred = found["status"] == Status.INFERRED
    assert sorted(asked) == np.flatnonzero(~inferred).tolist()
    for name, array in found.items():
        assert np.array_equal(array[~inferred], full[name][~inferred]), name
        assert array.dtype == full[name].dtype
    assert not any(found[name][inferred].any() for name in ("n_periods", "n_steps", "n_rejected"))
    # measured: 43 % of the cells integrated, all labels right
    assert (~inferred).mean() < 0.45
    as_closed = {**found, "status": np.where(inferred, Status.PERIODIC, found["status"])}
    assert (orbits.classes(as_closed) != labels).mean() < 1e-3


def test_infer__carries_all_but_the_work():
    def integrate(cells):
        n = len(cells)
        work = dict.fromkeys(("n_periods", "n_steps", "n_rejected"), cells + 1)
        values = {"section": np.full((n, 1, 4), 0.5), "status": np.full(n, Status.PERIODIC, np.int8)}
        values |= {"orbit_period": np.ones(n, np.int16), "turns": np.full((n, 2), 3, np.int32)}
        return values | work | {"lyapunov": np.stack([cells, -cells - 1.0], axis=1)}

    found = infer((9, 5), 4, integrate, closure_tolerance=1e-4, system=PENDULUM_FITTED)
    inferred = found["status"] == Status.INFERRED
    assert inferred.sum() == 45 - 6
    for name, value in (("section", 0.5), ("turns", 3), ("orbit_period", 1)):
        assert (found[name] == value).all()
    for name in ("n_periods", "n_steps", "n_rejected"):
        assert ((found[name] == 0) == inferred).all()
    # rows 0 to 4 of the first box, 5 to 8 of the second: first corners are cells 0 and 20
    expected = np.repeat([0, 20], [25, 20])
    assert (found["lyapunov"][:, 0][inferred] == expected[inferred]).all()
    assert (found["lyapunov"][:, 1] == -found["lyapunov"][:, 0] - 1.0).all()


# ---- runs --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def refined_run(tmp_path_factory):
    """A refined run and the full one."""
    folder = tmp_path_factory.mktemp("refined")
    for name, text in (("refined", RUN), ("full", RUN.replace("refine = 4\n", ""))):
        (folder / f"{name}.toml").write_text(text)
        assert quietly(folder / f"{name}.toml", folder / name).complete
    return folder


@pytest.mark.slow
def test_run__refined_against_the_full_grid(refined_run):
    one, full = (open_run(refined_run / name).load() for name in ("refined", "full"))
    inferred = (one.status == Status.INFERRED).values
    assert 0.2 < inferred.mean() < 0.95
    for name in one.data_vars:
        assert np.array_equal(one[name].values[~inferred], full[name].values[~inferred], equal_nan=True), name
    assert (full.status.values[inferred] == Status.PERIODIC).all()
    difference = np.abs(one.section - full.section).isel(period_index=-1).max("state").values
    assert (difference[inferred] < 1.0).mean() > 0.99
    assert state(refined_run / "refined").cells["inferred"] == inferred.sum()


@pytest.mark.slow
@pytest.mark.parametrize("lengths", [(17,), (5, 4, 4, 5)])
def test_compute__one_and_four_grid_dims(lengths):
    ranges = [
        f"{name} = {{ start = 0.1, stop = {0.1 + 1e-4 * n}, num = {n} }}"
        for name, n in zip(("psi1", "psi2", "psi1_dot", "psi2_dot"), lengths, strict=False)
    ]
    head, tail = RUN.split("psi1 =")[0], RUN[RUN.index("[integration]") :]
    text = "\n".join([head, *ranges, tail])
    spec, full = (Spec.parse(tomllib.loads(t)) for t in (text, text.replace("refine = 4\n", "")))
    plan = make_plan(spec)
    assert plan.shape == (2, *lengths)
    block = plan.task(0)
    values, expected = (compute(make_plan(s), block) for s in (spec, full))
    assert values["status"].shape == tuple(s.stop - s.start for s in block)
    own = values["status"] != Status.INFERRED
    assert not own.all()
    for name in values:
        assert np.array_equal(values[name][own], expected[name][own], equal_nan=True), name


# ---- layout ------------------------------------------------------------------------------------


def refined_text(shape, stride, extra=""):
    names = ("psi1", "psi2", "psi1_dot", "psi2_dot")
    ranges = "\n".join(f"{s} = {{ start = 0.0, stop = 1.0, num = {n} }}" for s, n in zip(names, shape, strict=False))
    return (
        'kind = "sweep"\n[axes]\nfrequency_hz = { values = [2.0, 2.5] }\n'
        f'[initial_conditions]\nkind = "grid"\nrefine = {stride}\n{ranges}\n'
        f"[integration]\nn_keep = 8\n{extra}"
    )


@pytest.mark.slow
@settings(deadline=None)
@given(
    st.lists(st.integers(16, 70), min_size=1, max_size=4),
    st.sampled_from([2, 4, 8, 16]),
    st.none() | st.integers(1, 5000),
)
def test_make_plan__tiles(shape, stride, wanted):
    extra = "" if wanted is None else f"[execution]\ntrajectories_per_task = {wanted}\n"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planning, "_refuse_large", lambda plan: None)
        plan = make_plan(Spec.parse(tomllib.loads(refined_text(shape, stride, extra))))
    assert plan.block[0] == 1
    for side, n in zip(plan.block[1:], shape, strict=True):
        assert side == n or side % stride == 0
    for variable in VARIABLES:
        assert plan.chunks(variable)[: len(plan.block)] == plan.block
    cut = [side for side, n in zip(plan.block[1:], shape, strict=True) if side < n]
    if cut and wanted is None:
        # sides grow in turns, then are made equal along each axis, in whole strides
        assert max(cut) <= 2 * min(cut) + stride


def test_identity__refinement_counts():
    text = refined_text((32, 32), 8)
    found = {}
    for change in ("refine = 8\n", "refine = 4\n", ""):
        spec = Spec.parse(tomllib.loads(text.replace("refine = 8\n", change)))
        assert Spec.parse(spec.as_dict()) == spec
        found[change] = make_plan(spec).identity
    assert found["refine = 8\n"]["refinement"] == REFINEMENT
    assert "refinement" not in found[""]
    assert "refine" not in found[""]["spec"]["initial_conditions"]
    assert found["refine = 8\n"] != found["refine = 4\n"]


@pytest.mark.parametrize(
    ("change", "path", "remedy"),
    [
        (("refine = 8", "refine = 12"), "initial_conditions.refine", "2, 4, 8, 16, 32, 64; take one"),
        (("refine = 8", "refine = true"), "initial_conditions.refine = True", "a whole number"),
        (("refine = 8", "refine = 64"), "initial_conditions.refine = 64", "at most 32, the points of psi1;"),
        (("n_keep = 8", "n_keep = 200000"), "initial_conditions.refine = 8", "lower refine or integration"),
        (
            ('kind = "sweep"', 'kind = "continuation"'),
            "initial_conditions.refine = 8",
            "a continuation cannot be refined; drop the key",
        ),
        (('kind = "grid"', 'kind = "list"\npoints = [[0, 0]]'), "initial_conditions.refine:", "only a grid"),
        (('kind = "grid"', 'kind = "grid" # fixed'), "initial_conditions.refine = 8", "there is no range"),
    ],
)
def test_parse_spec__refine_problems(change, path, remedy):
    text = refined_text((32, 40), 8)
    assert change[0] in text
    text = text.replace(*change)
    if any(word in text for word in ('"list"', "fixed")):
        text = "\n".join(line for line in text.splitlines() if not line.startswith("psi"))
    with pytest.raises(SpecError) as caught:
        Spec.parse(tomllib.loads(text))
    (problem,) = caught.value.problems
    assert problem.startswith(path)
    assert remedy in problem


def test_orbits__model_without_angles_has_no_turns():
    section = np.array([[[0.1, 0.2]], [[0.1, 0.2]], [[0.9, 0.0]]])
    cells = {"section": section, "status": np.full(3, Status.PERIODIC, np.int8), "orbit_period": np.ones(3, np.int16)}
    assert Orbits(1e-6, DUFFING).classes(cells).tolist() == [0, 0, 1]
