"""The compile cache: named by the sources, switched off by the environment; and without the compiler."""

import dataclasses
import gc
import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numba.core.compiler_lock import global_compiler_lock

import magpend_core
from magpend_core import accelerations, sections
from magpend_core.engine import jit
from magpend_core.engine.jit import bound_part, source_digest
from magpend_core.engine.lanes import engine_bindings
from magpend_core.engine.observers import RECORD
from magpend_core.engine.variational import with_tangents
from magpend_core.models.pendulum.systems import PENDULUM_FITTED
from tests.core import test_noisy

SCRIPT = """
import numba
before = numba.config.CACHE_DIR
from magpend_core import load_model, rates
from magpend_core.engine.jit import source_digest
from magpend_core.pointwise import _evaluator
model = load_model("duffing")
value = rates(0.1, [0.3, 0.4], model.load(damping=0.2, linear=1.0, cubic=1.0, amplitude=0.5), 2.2)
stats = _evaluator(model.system, "rates").__wrapped__.stats
print(source_digest(), value[1].hex(), sum(stats.cache_hits.values()), sum(stats.cache_misses.values()))
assert numba.config.CACHE_DIR == before  # numba's own setting is left alone
"""


def edit(folder, name, old, new):
    path = folder / "magpend_core" / name
    text = path.read_text("utf-8")
    assert text.count(old) == 1, old
    path.write_text(text.replace(old, new), "utf-8")


@pytest.mark.slow
def test_kernel__sees_an_edit_of_a_callee_in_a_folder_named_by_the_digest(run_python, copied, tmp_path):
    # the cached entry point is in pointwise.py, what it calls in the model's system.py
    first = run_python(SCRIPT, package=copied).split()
    (folder,) = (tmp_path / "cache").iterdir()
    assert folder.name.startswith(f"{first[0]}-numba-")
    assert list(folder.rglob("*.nbc"))
    # nothing beside the sources
    assert not [p for p in copied.rglob("*") if p.suffix in (".nbi", ".nbc")]
    again = run_python(SCRIPT, package=copied).split()
    assert first[:2] == again[:2]
    assert (first[2:], again[2:]) == (["0", "1"], ["1", "0"])
    edit(copied, "models/duffing/system.py", "return v, u - c[C.damping] * v", "return v, u - 1.01 * c[C.damping] * v")
    edited = run_python(SCRIPT, package=copied).split()
    assert edited[0] != first[0]
    assert edited[1] != first[1]
    assert edited[2:] == ["0", "1"]
    assert float.fromhex(edited[1]) == pytest.approx(float.fromhex(first[1]), rel=0.1)


def test_source_digest__changes_with_any_source(copied, monkeypatch):
    versions = {source_digest()}
    monkeypatch.setattr(jit, "_PACKAGE", copied / "magpend_core")
    assert {source_digest()} == versions  # of the same bytes
    for name in ("engine/vecmath.py", "status.py"):
        path = copied / "magpend_core" / name
        path.write_text(path.read_text("utf-8") + "\n# changed\n", "utf-8")
        versions.add(source_digest())
    assert len(versions) == 3
    assert all(re.fullmatch("[0-9a-f]{16}", version) for version in versions)


@pytest.mark.slow
def test_plain_python__gives_the_same_numbers(run_python, preset):
    # the same sources run without the compiler; only fused products round differently
    script = (
        "import numpy as np\n"
        "np.seterr(all='ignore')\n"
        "from magpend_core import accelerations, jacobian, load_preset, sections\n"
        "p, y = load_preset(), [0.05, 0.1, 1.0, -2.0]\n"
        "print(*accelerations(0.1, y, p, 2.2), *jacobian(0.1, y, p, 2.2).ravel())\n"
        "r = sections(p, 2.9, [y], n_transient=0, n_keep=1, rtol=1e-6, atol=1e-6)\n"
        "print(*r.section.ravel(), *r.n_steps)\n"
        "import test_noisy\n"
        "print(*test_noisy.run('ito', 3, 4, 1.0).section.ravel())\n"
    )
    path = os.pathsep.join(str(Path(module.__file__).parents[n]) for module, n in ((magpend_core, 1), (test_noisy, 0)))
    lines = run_python(script, package=path, NUMBA_DISABLE_JIT="1").splitlines()
    y = [0.05, 0.1, 1.0, -2.0]
    compiled = sections(preset, 2.9, [y], n_transient=0, n_keep=1, rtol=1e-6, atol=1e-6)
    values = np.array(lines[0].split(), dtype=float)
    assert values[:2] == pytest.approx(accelerations(0.1, y, preset, 2.2), rel=1e-12)
    slopes = magpend_core.jacobian(0.1, y, preset, 2.2).ravel()
    assert values[2:] == pytest.approx(slopes, rel=1e-11, abs=1e-10)
    section = np.array(lines[1].split(), dtype=float)
    assert section[:4] == pytest.approx(compiled.section.ravel(), abs=1e-9)
    assert section[4] == compiled.n_steps[0]
    noisy = test_noisy.run("ito", 3, 4, 1.0).section.ravel()
    assert np.array(lines[2].split(), dtype=float) == pytest.approx(noisy, rel=1e-13)


@pytest.mark.parametrize("changes", [{"escape": (1.0, 1.0, 1.0, 1.0)}, {"units": (1.0, 1.0, 5.0, 5.0)}])
def test_label__follows_the_data(changes):
    """Data of a system go into its compiled code, so they must go into the name under which it is kept."""
    changed = dataclasses.replace(PENDULUM_FITTED, **changes)
    assert changed.name == PENDULUM_FITTED.name
    assert changed.label != PENDULUM_FITTED.label
    assert dataclasses.replace(PENDULUM_FITTED).label == PENDULUM_FITTED.label


class _Rows(NamedTuple):
    state: int
    size: int


def _shifted(w):
    return w + OFFSET + ROWS.state  # noqa: F821 # bound by bound_part


def test_bound_part__is_shared_where_all_that_it_uses_agrees():
    first = bound_part(_shifted, {"OFFSET": 7, "ROWS": _Rows(1, 2), "other": 1}, True)
    assert bound_part(_shifted, {"OFFSET": 7, "ROWS": _Rows(1, 3), "other": 2}, True) is first
    for differs in (
        {"OFFSET": 7.0, "ROWS": _Rows(1, 2)},
        {"OFFSET": True, "ROWS": _Rows(1, 2)},
        {"OFFSET": 7, "ROWS": _Rows(0, 2)},
        {"OFFSET": np.array([7]), "ROWS": _Rows(1, 2)},
    ):
        assert bound_part(_shifted, differs, True) is not first
    assert bound_part(_shifted, {"OFFSET": 7, "ROWS": _Rows(1, 2)}, False) is not first
    zero, minus = ({"OFFSET": x, "ROWS": _Rows(1, 2)} for x in (0.0, -0.0))
    assert bound_part(_shifted, zero, True) is not bound_part(_shifted, minus, True)


@pytest.mark.parametrize("system", [PENDULUM_FITTED, with_tangents(PENDULUM_FITTED, 4)])
def test_bound_part__no_two_of_an_engine_have_one_name(monkeypatch, system):
    """Parts are linked by names: within an engine one name must be one content."""
    monkeypatch.setattr(jit, "_PARTS", {})
    engine_bindings(system, RECORD)
    parts = [part.py_func for part, _ in jit._PARTS.values()]
    names = [f"{f.__module__}.{f.__qualname__}" for f in parts]
    assert len(names) > 20
    assert len(set(names)) == len(names)


def test_compilation__leaves_garbage_alone_and_the_collector_as_it_was():
    with global_compiler_lock, global_compiler_lock:
        assert not gc.isenabled()
    assert gc.isenabled()
    gc.disable()
    try:
        with global_compiler_lock:
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
