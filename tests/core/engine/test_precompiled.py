"""Parts of engines: compiled once for all systems, kept on disk, linked with each system's sizes."""

import os
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from magpend_core.engine import jit, linking
from magpend_core.engine.code_cache import PartFolder
from magpend_core.engine.jit import bound_part, entry, inline
from magpend_core.engine.simd import WIDTH, load, load_rows, store
from tests.core.conftest import run_script

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")

RUN = """
import sys
import numpy as np
from numba.core import event
from magpend_core.models import load_model
from magpend_core.sections import sections

class Compiled(event.Listener):
    def on_start(self, event):
        dispatcher = event.data["dispatcher"]
        names.append(dispatcher.py_func.__qualname__)
    def on_end(self, event):
        pass

for name in sys.argv[1:]:
    names = []
    listener = Compiled()
    event.register("numba:compile", listener)
    model = load_model(name)
    start = np.full((3, model.system.n_states), 0.1) * [[1.0], [2.0], [3.0]]
    found = sections(model.load(), 0.3, start, n_transient=3, n_keep=2, rtol=1e-7, atol=1e-7)
    event.unregister("numba:compile", listener)
    print(name, found.section.tobytes().hex(), found.n_steps.sum(), ",".join(names) or "nothing")
"""


def integrated(folder, *models, **variables):
    """Integrate models one after the other in a fresh process; return a row of words for each."""
    out = run_script(folder, RUN.replace("sys.argv[1:]", repr(list(models))), **variables)
    return {line.split()[0]: line.split()[1:] for line in out.splitlines()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("parts")


@pytest.fixture(scope="module")
def cold(folder):
    """Rows of a process that begins with an empty cache."""
    return integrated(folder, "driven-pendulum", "duffing", "three-magnets")


@pytest.mark.slow
def test_parts__a_second_system_compiles_its_equations_alone(cold):
    """Other states, other constants, angles or none: what knows no equations is had from the first one."""
    assert len(cold["driven-pendulum"][2].split(",")) > 30
    # besides the equations: the entry, which Python calls, and the stages, in which the equations are
    mine = ("_rhs", "_forcing", "_constants", "_no_edges", "advance_duffing", "run_stages")
    others = [name for name in cold["duffing"][2].split(",") if not name.startswith(mine)]
    assert not others


@pytest.mark.slow
def test_parts__bits_depend_on_the_system_alone(cold, folder, tmp_path):
    """From nothing after others or alone, without a cache, from the cache, and from one that is damaged.

    A process that compiles runs its callees as they were compiled alone, one that reads the cache those that were
    optimised once more as parts of the whole.
    """
    bits = {name: row[:2] for name, row in cold.items()}
    alone = integrated(tmp_path, "three-magnets", "duffing", MAGPEND_CACHE="0")
    assert not list(tmp_path.iterdir())  # nor anything beside the sources
    assert not [p for p in Path(jit.__file__).parents[1].rglob("*") if p.suffix in (".nbi", ".nbc")]
    assert {name: row[:2] for name, row in alone.items()} == {name: bits[name] for name in alone}
    read = integrated(folder, "duffing", "driven-pendulum")
    assert {name: row[:2] for name, row in read.items()} == {name: bits[name] for name in read}
    damage(folder / "cache")
    assert integrated(folder, "duffing")["duffing"][:2] == bits["duffing"]


SAMPLE = """
from magpend_core.engine import jit
from magpend_core.models import load_model
from magpend_core.sampling import sample
from numba.core import types

model = load_model("duffing")
sample(model.system, model.load().pack()[None], [[0.2, 0.0]], [[0.5]])
given = [(part.py_func.__name__, types_) for part, _ in jit._PARTS.values() for types_ in part.overloads]
print(len(given), *[name for name, types_ in given if any(isinstance(one, types.Literal) for one in types_)])
"""


@pytest.mark.slow
def test_parts__of_the_sampling_loop_are_compiled_for_no_literal(tmp_path):
    """numba types a plain 0 as a literal, and would compile every part that is called with one once more."""
    n, *literal = run_script(tmp_path, SAMPLE, MAGPEND_CACHE="0").split()
    assert int(n) >= 15
    assert not literal


def damage(cache):
    """Take away the engines, and damage some of their parts each in its own way."""
    records = sorted(cache.rglob("*.part"))
    assert len(records) > 30
    for engine in cache.rglob("*.nbc"):
        engine.unlink()
    content = [record.read_bytes() for record in records]
    half = len(content[0]) // 2
    records[0].write_bytes(content[0][:half] + bytes([content[0][half] ^ 4]) + content[0][half + 1 :])
    records[1].write_bytes(content[1][:100])
    records[2].write_bytes(b"")
    records[3].unlink()
    records[3].mkdir()
    records[4].write_bytes(content[5])
    records[5].write_bytes(content[4])


def _sum_of_states(w, out):
    """Sum of the first entry of each state, and what its array says of it."""
    for i in range(N):  # noqa: F821
        out[0] += w[ROWS.state + i * WIDTH]  # noqa: F821
        out[1] += SCALES[i] * (IS_ANGLE[i] + 1)  # noqa: F821


def sizes(n):
    rows = namedtuple("Rows", ("state", "size"))(n * WIDTH, 3 * n * WIDTH)
    return {"N": n, "ROWS": rows, "SCALES": np.arange(1.0, n + 1), "IS_ANGLE": np.arange(n) % 2}


def expected(n):
    return [sum(range(n * WIDTH, 2 * n * WIDTH, WIDTH)), sum((i + 1) * (i % 2 + 1) for i in range(n))]


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_bound_part__is_one_code_with_the_sizes_of_each_system(n):
    part = bound_part(_sum_of_states, sizes(n), False)
    out = np.zeros(2)
    # also called from a function that numba compiles in its own way
    njit(lambda w, out: part(w, out))(np.arange(3.0 * n * WIDTH), out)
    np.testing.assert_array_equal(out, expected(n))
    assert part.key == bound_part(_sum_of_states, sizes(n + 1), False).key


def _in_a_constant(out):
    out[0] = N  # noqa: F821


def test_size_in_a_constant__is_an_error_and_not_a_wrong_number(monkeypatch):
    monkeypatch.setattr(linking, "_load_sizes", lambda *_: None)
    part = bound_part(_in_a_constant, {"N": 3}, False)
    with pytest.raises(RuntimeError, match="has N in a constant"):
        njit(lambda out: part(out))(np.zeros(1))


def _first(out):
    out[0] = second(out) + N  # noqa: F821


def _second(out):
    return 10.0 * N  # noqa: F821


def test_parts_of_one_engine__agree_in_their_sizes():
    other = bound_part(_second, {"N": 4}, False)
    first = entry(_first, "disagrees", {"second": other, "N": 3}, None)
    with pytest.raises(RuntimeError, match="disagree in N: 3 and 4"):
        first(np.zeros(1))
    agrees = entry(_first, "agrees", {"second": bound_part(_second, {"N": 3}, False), "N": 3}, None)
    out = np.zeros(1)
    agrees(out)
    assert out[0] == 33.0


def _of_a_pair(w, out):
    """Take from the first of a tuple of any length."""
    out[0] = firsts(w)[0] + N  # noqa: F821


def test_part__is_kept_for_each_type_that_its_callees_return(monkeypatch, tmp_path):
    """One system after the other, each in what would be a process of its own: a record replaces no other one."""
    code = {n: f"def firsts(w):\n    return ({'w[0], ' * n})\n" for n in (2, 3)}

    def compiled(n):
        monkeypatch.setattr(jit, "_PARTS", {})
        scope = {"__name__": jit.__name__}
        exec(code[n], scope)
        part = bound_part(_of_a_pair, {"firsts": inline(scope["firsts"]), "N": n}, False)
        out = np.zeros(1)
        njit(lambda w, out: part(w, out))(np.full(1, 0.5), out)
        assert out[0] == 0.5 + n
        return sum(part.stats.cache_misses.values())

    monkeypatch.setattr(jit, "PARTS", PartFolder(tmp_path / "cache"))
    monkeypatch.setattr(_of_a_pair, "__module__", jit.__name__)  # only parts of the package are kept
    assert [compiled(n) for n in (2, 3, 2, 3)] == [1, 1, 0, 0]


def test_inline__can_be_called_from_python_too():
    @inline
    def cubed(x):
        return x * x * x

    @njit
    def both(x):
        return cubed(x) + 1.0

    assert (both(2.0), cubed(2.0), cubed(3.0)) == (9.0, 8.0, 27.0)


def test_load_rows__of_so_many_rows_is_compiled_for_each_number():
    def total(w, out):
        rows = load_rows(w, 0, N)  # noqa: F821
        store(out, 0, rows[0] + rows[N - 1])  # noqa: F821

    for n in (1, 2, 5):
        part = bound_part(total, {"N": n, "load_rows": load_rows, "load": load}, False)
        w, out = np.arange(5.0 * WIDTH), np.zeros(WIDTH)
        njit(lambda w, out, part=part: part(w, out))(w, out)
        np.testing.assert_array_equal(out, w[:WIDTH] + w[(n - 1) * WIDTH : n * WIDTH])
