"""What the tests of the core share: reference numbers, parameter sets, a second system, subprocesses."""

import json
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import magpend_core
from magpend_core import load_model, load_preset
from magpend_core.engine.jit import inline
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import sincos

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="session")
def preset():
    return load_preset()


@pytest.fixture(scope="session")
def dipoles(preset):
    """The preset with point dipoles that are about as strong as the fitted magnets."""
    return load_model("pendulum-dipole").load(pole1=120.0, pole2=120.0)


@pytest.fixture(scope="session")
def bare():
    """The two links alone: no friction, no drive, no magnets."""
    return load_preset(T1=0.0, T2=0.0, c=0.0, mu=0.0, q=0.0, alpha1=0.0, alpha2=0.0)


@pytest.fixture(scope="session")
def reference():
    """Read a file of reference numbers (see data/README.md)."""

    def read(name):
        return json.loads((DATA / f"{name}.json").read_text("utf-8"))

    return read


@inline
def _oscillator_constants(frequency, p, out):
    for i in range(4):
        out[i] = p[i]
    out[4] = 2.0 * np.pi * frequency


@inline
def _oscillator_forcing(t, c):
    return c[3] * sincos(c[4] * t)[1]


@inline
def _oscillator_rhs(y, u, c):
    damping, linear, cubic = c[0], c[1], c[2]
    x, v, a11, a12, a21, a22 = y
    stiffness = linear + 3.0 * cubic * x * x
    return (
        v,
        u - damping * v - linear * x - cubic * x * x * x,
        a21,
        a22,
        -damping * a21 - stiffness * a11,
        -damping * a22 - stiffness * a12,
    )


@inline
def _oscillator_jacobian(y, u, c):
    zero = 0.0 * y[0]
    return (zero, zero + 1.0, -c[1] - 3.0 * c[2] * y[0] * y[0], zero - c[0])


@inline
def _duffing_rhs(y, u, c):
    return (y[1], u - c[0] * y[1] - c[1] * y[0] - c[2] * y[0] * y[0] * y[0])


def _oscillator(name, states, rhs, escape):
    return System(
        name=name,
        state_names=states,
        parameter_names=("damping", "linear", "cubic", "amplitude"),
        n_constants=5,
        constants=_oscillator_constants,
        forcing=_oscillator_forcing,
        rhs=rhs,
        jacobian=_oscillator_jacobian,
        escape=escape,
    )


@pytest.fixture(scope="session")
def oscillator():
    """x'' = amplitude cos(2 pi f t) - damping x' - linear x - cubic x^3, with its variational equation.

    The last four states are the derivative of (x, x') by the initial state, row by row.
    """
    states = ("x", "v", "a11", "a12", "a21", "a22")
    return _oscillator("forced_oscillator", states, _oscillator_rhs, (1e3, 1e3, 1e6, 1e6, 1e6, 1e6))


@pytest.fixture(scope="session")
def duffing():
    """The same oscillator without the derivatives."""
    return _oscillator("forced_oscillator_alone", ("x", "v"), _duffing_rhs, (1e3, 1e3))


@pytest.fixture
def copied(tmp_path):
    """A copy of the package that a test may edit: the folder that holds it."""
    source = Path(magpend_core.__file__).parent
    shutil.copytree(source, tmp_path / "copy" / "magpend_core", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "copy"


@pytest.fixture
def run_python(tmp_path):
    """Run a script in a fresh interpreter; return what it prints.

    `package` is the folder that holds ``magpend_core``; the compile cache is `tmp_path` unless `env`
    says otherwise.
    """

    return partial(run_script, tmp_path)


def run_script(folder, script, *, package=Path(magpend_core.__file__).parent.parent, **env):
    """Run a script in a fresh interpreter in a folder, which also holds its compile cache; return what it prints."""
    keep = {k: v for k, v in os.environ.items() if not k.startswith(("NUMBA_", "MAGPEND_", "COV"))}
    settings = {"MAGPEND_CACHE_DIR": str(folder / "cache"), **env, "PYTHONPATH": str(package)}
    words = [sys.executable, "-W", "error", "-c", script]
    done = subprocess.run(
        words, env=keep | settings, cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def _pendulum_rhs(p, torque):
    """The pendulum without magnets and load-dependent friction, written out from Eq. 1-8."""
    B1 = p["J1"] + p["e1"] ** 2 * p["m1"] + p["l1"] ** 2 * p["m2"]
    B2 = p["J2"] + p["e2"] ** 2 * p["m2"]
    N = p["m2"] * p["e2"] * p["l1"]
    M1, M2 = p["m1"] * p["g"] * p["e1"] + p["m2"] * p["g"] * p["l1"], p["m2"] * p["g"] * p["e2"]

    def dry(v):
        stribeck = (1 - p["mu0"]) * np.exp(-p["c0"] * abs(v)) + p["mu0"]
        return 2 / np.pi * np.arctan(p["eps"] * v) * stribeck

    def rhs(t, y):
        a, b, v, w = y
        s, c = np.sin(a - b), np.cos(a - b)
        R1 = p["T1"] * dry(v) + 2 * p["c"] * v
        R2 = p["T2"] * dry(w - v) + p["c"] * (w - v)
        matrix = [[B1, N * c], [N * c, B2]]
        right = [torque(t) - R1 + R2 - N * s * w**2 - M1 * np.sin(a), N * s * v**2 - M2 * np.sin(b) - R2]
        return [v, w, *np.linalg.solve(matrix, right)]

    return rhs


@pytest.fixture(scope="session")
def pendulum_rhs():
    """From parameters and a torque of time to a right-hand side that shares nothing with the engine."""
    return _pendulum_rhs
