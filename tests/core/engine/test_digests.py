"""Digests of functions from outside the package; machine code kept under them is never an old one."""

import math
import os
from collections import namedtuple

import numpy as np
import pytest
from numba import njit

from magpend_core.engine import vecmath
from magpend_core.engine.digests import functions_digest
from magpend_core.engine.jit import inline, keeping
from magpend_core.models.pendulum.systems import PENDULUM_FITTED

SOURCE = """
import math
import numpy as np
from magpend_core.engine import vecmath
from magpend_core.engine.jit import inline
from magpend_core.engine.vecmath import sincos

FACTOR = 2.0
TABLE = np.array([1.0, 2.0])
AT = Places(0, 1)

@inline
def callee(x):
    return 3.0 * x

def closed(shift):
    @inline
    def inner(x):
        return x + shift
    return inner

shifted = closed(0.5)

@inline
def entry(x, n=2):
    much = TABLE[AT.b] + shifted(x) + math.sqrt(2.0) * np.pi
    return FACTOR * callee(x) + much + sincos(x)[0] + vecmath.exp(x)
"""


def digest_of(source, module=__name__):
    scope = {"Places": namedtuple("Places", ("a", "b")), "__name__": module}
    exec(source, scope)
    return functions_digest(scope["entry"])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("3.0 * x", "3.0 + x"),
        ("3.0 * x", "3.1 * x"),
        ("FACTOR = 2.0", "FACTOR = 2.0000000000000004"),
        ("FACTOR = 2.0", "FACTOR = 2"),
        ("[1.0, 2.0]", "[1.0, 2.5]"),
        ("[1.0, 2.0]", "[[1.0], [2.0]]"),
        ("Places(0, 1)", "Places(0, 0)"),
        ("closed(0.5)", "closed(0.25)"),
        ("n=2", "n=3"),
        ("np.pi", "np.e"),
        ("math.sqrt", "math.exp"),
        ("sincos(x)[0]", "sincos(x)[1]"),
        ("vecmath.exp(x)", "vecmath.log(x)"),
        ("@inline\ndef entry", "from numba import njit\n@njit(fastmath=True)\ndef entry"),
    ],
)
def test_functions_digest__changes_with_all_that_is_reached(old, new):
    assert SOURCE.count(old) == 1
    assert digest_of(SOURCE.replace(old, new)) != digest_of(SOURCE)
    # and with nothing else
    rest = SOURCE.replace("    return 3.0 * x", "    # a reason\n    return 3.0 * x").replace(
        "= 2.0", "= 2.0\nUNUSED = 5"
    )
    assert digest_of(rest) == digest_of(SOURCE)


class Counter:
    value = 1.0


COUNTER = Counter()
later = {}


def _plain_helper(x):
    return x


@njit
def _of_state(x):
    return x + COUNTER.value


@njit
def _of_plain_function(x):
    return _plain_helper(x)


@njit
def _of_missing(x):
    return x + not_there  # noqa: F821


@njit
def _of_module(x):
    return len(dir(np)) + x


@pytest.mark.parametrize("function", [_of_state, _of_plain_function, _of_missing, _of_module])
def test_functions_digest__none_if_something_cannot_be_followed(function):
    assert functions_digest(function) is None
    assert keeping(function) is None


def test_functions_digest__of_recursion_of_no_module_and_of_the_package():
    @inline
    def falling(n):
        return 1.0 if n <= 0 else n * falling(n - 1)

    assert len(functions_digest(falling)) == 64
    # the compile cache imports the module when it is read
    assert digest_of(SOURCE, "a_module_that_is_not_there") is None

    @inline
    def mine(x):
        return vecmath.exp(x) + math.pi

    assert keeping(vecmath.exp, vecmath.sin) == ""
    assert keeping(vecmath.exp, mine) == functions_digest(vecmath.exp, mine)


MODULE = """
from magpend_core.engine.jit import inline
from magpend_core.engine.system import System
from other import stiffness

@inline
def constants(frequency, p, out):
    out[0] = p[0]

@inline
def rhs(y, u, c):
    return (-stiffness(y[0]) - c[0] * y[0],)

SYSTEM = System(name="mine", state_names=("x",), parameter_names=("d",), n_constants=1,
                constants=constants, rhs=rhs)
"""
OTHER = """
from magpend_core.engine.jit import inline

SCALE = 1.0

@inline
def stiffness(x):
    return SCALE * x
"""
RUN = """
import sys
sys.path.insert(0, "theirs")
from magpend_core import run_branches
from magpend_core.engine.digests import functions_digest
from magpend_core.engine.lanes import engine_of
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from magpend_core.engine import entry
from mine import SYSTEM
engines = []
entry.engine_of = lambda *a: engines.append(engine_of(*a)) or engines[-1]
found = run_branches(parameters=[[[0.1]]], frequency_hz=[[0.5]], initial_states=[[1.0]],
                     n_transient=0, n_keep=1, rtol=1e-9, atol=1e-9, system=SYSTEM)
stats = engines[0].__wrapped__.stats
print(found.section.ravel()[0].hex(), sum(stats.cache_hits.values()), sum(stats.cache_misses.values()))
print(functions_digest(*PENDULUM_FITTED.functions))
"""


@pytest.mark.slow
def test_kernel__of_a_system_from_outside_is_kept_and_never_old(run_python, tmp_path):
    folder, seeds = tmp_path / "theirs", iter("1234")
    folder.mkdir()
    (folder / "mine.py").write_text(MODULE, "utf-8")
    (folder / "other.py").write_text(OTHER, "utf-8")

    def run():
        # Python's own kept bytecode goes by seconds and sizes: too coarse for a test
        found = run_python(RUN, PYTHONDONTWRITEBYTECODE="1", PYTHONHASHSEED=next(seeds)).split()
        assert found.pop() == functions_digest(*PENDULUM_FITTED.functions)  # in every process
        return found

    first, again = run(), run()
    assert (first[1:], again[1:]) == (["0", "1"], ["1", "0"])
    assert first[0] == again[0]
    # an edit in the module that it calls, of a number that no bytecode shows
    (folder / "other.py").write_text(OTHER.replace("SCALE = 1.0", "SCALE = 1.5"), "utf-8")
    edited = run()
    assert edited[1:] == ["0", "1"]
    assert edited[0] != first[0]
    # x' = -1.5 x - x/10 after 2 s
    assert float.fromhex(edited[0]) == pytest.approx(math.exp(-3.2), abs=1e-6)
    # and back: the first answer is still there
    (folder / "other.py").write_text(OTHER, "utf-8")
    assert run() == again


TEXT = """
from magpend_core import load_model
from magpend_core.engine.lanes import engine_of
from magpend_core.engine import entry
from magpend_core.sections import sections
model = load_model("duffing5")
engines = []
entry.engine_of = lambda *a: engines.append(engine_of(*a)) or engines[-1]
for amplitude in (0.2, 0.4):
    found = sections(model.load(A=amplitude), 0.5, [[1.0, 0.0]], n_transient=0, n_keep=1)
    stats = engines[0].__wrapped__.stats
    print(found.section.ravel()[0].hex(), sum(stats.cache_hits.values()), sum(stats.cache_misses.values()))
assert engines[1] is engines[0]
"""


@pytest.mark.slow
def test_kernel__of_a_text_is_kept_and_its_parameters_values_compile_nothing(run_python):
    # where all tests keep theirs: others need this engine, and may have compiled it
    home = os.environ["MAGPEND_CACHE_DIR"]
    first, again = (run_python(TEXT, MAGPEND_CACHE_DIR=home).split() for _ in range(2))
    assert first[1:3] in (["0", "1"], ["1", "0"])
    assert again[1:3] == ["1", "0"]
    for found in (first, again):
        assert found[0] != found[3]
        assert found[4:] == found[1:3]  # nothing more for the other amplitude
    assert (again[0], again[3]) == (first[0], first[3])
