"""Bits depend on the trajectory alone: not on lanes, neighbours, order, CPU, compiler or restarts."""

import hashlib
import os
import platform
import shutil
from pathlib import Path

import llvmlite.binding
import numpy as np
import pytest

import magpend_core
from magpend_core import Status, load_model, load_preset, run_branches
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from tests.core import test_noisy


def many(n=96):
    """Branches of one point that all differ in frequency, parameters and start."""
    rng = np.random.default_rng(11)
    preset = load_preset()
    packed = np.tile(preset.pack(), (n, 1, 1))
    for name, spread in (("q", 0.1), ("mu", 0.3), ("alpha1", 0.3), ("T1", 0.2), ("duty_cycle", 0.05)):
        packed[:, 0, preset.names.index(name)] *= rng.uniform(1.0 - spread, 1.0 + spread, n)
    frequency = rng.uniform(1.0, 3.0, (n, 1))
    starts = rng.uniform(-1.0, 1.0, (n, 4)) * [np.pi, np.pi, 15.0, 15.0]
    return packed, frequency, starts


def run_many(packed, frequency, starts, **options):
    settings = {"n_transient": 7, "n_keep": 3, "rtol": 1e-7, "atol": 1e-7, "system": PENDULUM_FITTED, **options}
    return run_branches(packed, frequency, starts, **settings)


FIELDS = (
    "section",
    "turns",
    "status",
    "orbit_period",
    "n_periods",
    "n_steps",
    "n_rejected",
    "final_state",
    "step_size",
)


def assert_same_bits(a, b, rows=slice(None)):
    for name in FIELDS:
        assert getattr(a, name)[rows].tobytes() == getattr(b, name).tobytes(), name


@pytest.fixture(scope="module")
def straight():
    """`many` with the default lanes; they are motions of all kinds."""
    found = run_many(*many())
    assert np.isfinite(found.section).all()
    assert np.any(found.turns != 0)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("n_lanes", [1, 8, 16, 40, 96, 1000])
def test_engine__same_bits_for_any_number_of_lanes(straight, n_lanes):
    assert_same_bits(straight, run_many(*many(), n_lanes=n_lanes))


def test_engine__same_bits_in_any_company(straight):
    order = np.random.default_rng(12).permutation(96)
    shuffled = run_many(*(array[order] for array in many()), n_lanes=24)
    assert_same_bits(straight, shuffled, order)
    for rows in ([0], [37], [95], [5, 90], list(range(40, 71))):
        assert_same_bits(straight, run_many(*(array[rows] for array in many())), rows)
    # a neighbour that ends at once and one that diverges
    packed, frequency, starts = many()
    starts[3] = [0.0, 0.0, 1e6, -1e6]
    packed[7] = np.tile(load_preset(q=0.0).pack(), (1, 1))
    starts[7] = 0.0
    mixed = run_many(packed, frequency, starts, n_lanes=16, max_steps_per_period=3000)
    assert mixed.status[3, 0] in (Status.DIVERGED, Status.STEP_LIMIT)
    others = np.setdiff1d(np.arange(96), [3, 7])
    assert mixed.section[others].tobytes() == straight.section[others].tobytes()


AVX2 = "+avx,+avx2,+fma,+bmi,+bmi2,+f16c,+lzcnt,+movbe,+popcnt,+sse3,+ssse3,+sse4.1,+sse4.2"
AVX512 = AVX2 + ",+avx512f,+avx512bw,+avx512cd,+avx512dq,+avx512vl,-prefer-256-bit"
BUILDS = {
    "avx2": {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": AVX2},
    "avx512": {"NUMBA_CPU_NAME": "skylake-avx512", "NUMBA_CPU_FEATURES": AVX512},
    # the C library computes what this CPU has no operation for; nothing is optimised; and a trajectory at a
    # time, as on a device that has no vectors
    "scalar-without-fused-operation": {"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": "", "NUMBA_OPT": "0"},
}
INSTRUCTIONS = {"avx2": "ymm fma", "avx512": "zmm ymm fma", "scalar-without-fused-operation": ""}
SCRIPT = """
import hashlib
import numpy as np
import test_noisy
from magpend_core import load_model, run_branches
from magpend_core.engine.lanes import engine_of
from magpend_core.engine.observers import RECORD
from magpend_core.engine.simd import WIDTH
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
def digest(found):
    return hashlib.sha256(found.section.tobytes() + found.n_steps.tobytes()).hexdigest()
inputs = np.load("inputs.npz")
packed, frequency, starts = (inputs[k] for k in ("packed", "frequency", "starts"))
settings = {"n_transient": 7, "n_keep": 3, "rtol": 1e-7, "atol": 1e-7, "system": PENDULUM_FITTED}
print(digest(run_branches(packed, frequency, starts, **settings)))
packed, frequency, starts = (inputs["struck_" + k] for k in ("packed", "frequency", "starts"))
settings = {"n_transient": 0, "n_keep": 9, "rtol": 1e-7, "atol": 1e-7, "system": load_model("impact").system}
print(digest(run_branches(packed, frequency, starts, **settings)))
settings = {"n_transient": 3, "n_keep": 3, "rtol": 1e-7, "atol": 1e-7, "method": "rodas5p"}
packed, frequency, starts = (inputs["stiff_" + k] for k in ("packed", "frequency", "starts"))
print(digest(run_branches(packed, frequency, starts, system=load_model("flutter").system, **settings)))
print(test_noisy.digest())
code = "".join(engine_of(PENDULUM_FITTED, RECORD, ()).__wrapped__.inspect_asm().values())
print(WIDTH)
print(*[word for word in ("zmm", "ymm") if word in code], *["fma"] * ("vfmadd" in code))
"""


def struck():
    """Branches of an oscillator that strikes a stop: with instants to be found, and jumps."""
    model = load_model("impact")
    rng = np.random.default_rng(13)
    packed = np.tile(model.load().pack(), (40, 1, 1))
    packed[:, 0, model.parameter_names.index("A")] *= rng.uniform(0.5, 2.0, 40)
    return packed, rng.uniform(0.1, 0.3, (40, 1)), rng.uniform(-1.0, 1.0, (40, 2))


def stiff():
    """Branches of six states for the implicit method."""
    model = load_model("flutter")
    packed = np.tile(model.load().pack(), (40, 1, 1)) * np.random.default_rng(17).uniform(0.9, 1.1, (40, 1, 1))
    return packed, np.full((40, 1), 1.0), np.random.default_rng(19).uniform(-1.0, 1.0, (40, 6))


def digest(found):
    return hashlib.sha256(found.section.tobytes() + found.n_steps.tobytes()).hexdigest()


@pytest.fixture(scope="module")
def straight_struck():
    return run_many(*struck(), system=load_model("impact").system, n_transient=0, n_keep=9)


@pytest.fixture(scope="module")
def straight_stiff():
    found = run_many(*stiff(), system=load_model("flutter").system, n_transient=3, n_keep=3, method="rodas5p")
    assert np.isfinite(found.section).all()
    return found


@pytest.mark.slow
@pytest.mark.parametrize("build", BUILDS)
def test_engine__same_bits_however_it_is_built(straight, straight_struck, straight_stiff, run_python, tmp_path, build):
    settings, package = BUILDS[build], Path(magpend_core.__file__).parent.parent
    if settings and platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip(f"this machine, a {platform.machine()}, cannot run code for {build}")
    features = llvmlite.binding.get_host_cpu_features()
    if build == ("avx512" if features.get("avx512vl") else "avx2"):
        pytest.skip(f"this machine's own build, which the others are compared with, is one for {build}")
    wanted = [f[1:] for f in settings.get("NUMBA_CPU_FEATURES", "").split(",") if f.startswith("+")]
    missing = [f for f in wanted if not features.get(f)]
    if missing:
        pytest.skip(f"this machine cannot run code for {build}: it lacks {', '.join(missing)}")
    if build.startswith("scalar"):
        package = tmp_path / "scalar"
        shutil.copytree(Path(magpend_core.__file__).parent, package / "magpend_core")
        simd = package / "magpend_core" / "engine" / "simd.py"
        simd.write_text(simd.read_text().replace("WIDTH = 16\n", "WIDTH = 1\n"))
    names = "packed", "frequency", "starts"
    inputs = dict(zip(names, many(), strict=True)) | {
        f"{kind}_{name}": x
        for kind, cells in (("struck", struck()), ("stiff", stiff()))
        for name, x in zip(names, cells, strict=True)
    }
    np.savez(tmp_path / "inputs.npz", **inputs)
    path = f"{package}{os.pathsep}{Path(test_noisy.__file__).parent}"
    out = run_python(SCRIPT, package=path, MAGPEND_CACHE="0", **settings).splitlines()
    assert out[:4] == [digest(straight), digest(straight_struck), digest(straight_stiff), test_noisy.digest()]
    assert out[4] == ("1" if build.startswith("scalar") else "16")
    assert out[5] == INSTRUCTIONS[build]


def test_run_branches__continues_bit_for_bit():
    # over many frequencies, because the rounding of the drive's phase differs among them
    packed, frequency, starts = many(200)
    whole = run_many(packed, frequency, starts, n_transient=0, n_keep=6)
    first = run_many(packed, frequency, starts, n_transient=0, n_keep=2)
    state, step = first.final_state[:, 0], first.step_size[:, 0]
    second = run_many(packed, frequency, state, step_size=step, n_transient=0, n_keep=4)
    together = np.concatenate([first.section, second.section], axis=2)
    assert together.tobytes() == whole.section.tobytes()
    assert second.final_state.tobytes() == whole.final_state.tobytes()
    assert second.step_size.tobytes() == whole.step_size.tobytes()
    # the rotating ones are among them
    assert np.any(whole.turns != 0)


def test_run_branches__each_point_starts_where_the_last_ended():
    packed, frequency, starts = many(48)
    settings = {"n_transient": 1, "n_keep": 2}
    shifts = [0.0, 0.01, 0.03]
    path = np.concatenate([frequency + shift for shift in shifts], axis=1)
    walked = run_many(np.tile(packed, (1, 3, 1)), path, starts, **settings)
    state, step = starts, None
    for k in range(3):
        point = run_many(packed, path[:, k : k + 1], state, step_size=step, **settings)
        state, step = point.final_state[:, 0], point.step_size[:, 0]
        for name in FIELDS:
            assert getattr(walked, name)[:, k].tobytes() == getattr(point, name)[:, 0].tobytes(), name
    assert (walked.final_state == walked.section[:, :, -1]).all()


def test_run_branches__first_step_may_be_given():
    packed, frequency, starts = many(4)
    settings = {"n_transient": 0, "n_keep": 2, "rtol": 1e-9, "atol": 1e-9, "system": PENDULUM_FITTED}
    own = run_branches(packed, frequency, starts, **settings)
    zero = run_branches(packed, frequency, starts, step_size=np.zeros(4), **settings)
    given = run_branches(packed, frequency, starts, step_size=np.full(4, 1e-6), **settings)
    assert own.section.tobytes() == zero.section.tobytes()
    assert (given.n_steps > own.n_steps).all()
    assert np.max(abs(given.section - own.section)) < 1e-5
    arguments = many(4)
    before = [a.copy() for a in arguments]
    step = np.full(4, 1e-4)
    run_many(*arguments, step_size=step)
    assert all((a == b).all() for a, b in zip(arguments, before, strict=True))
    assert (step == 1e-4).all()
