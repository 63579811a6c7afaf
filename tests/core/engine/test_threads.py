"""Threads share the rows of a call: every door of the engine gives the same bytes with 1, 2 and 3 threads."""

import threading

import numba
import numpy as np
import pytest

from magpend_core import lyapunov_exponents, run_branches
from magpend_core.disturbance import Disturbance
from magpend_core.engine import threads
from magpend_core.engine.simd import WIDTH, take
from magpend_core.engine.threads import number_of_threads, share, using_threads
from magpend_core.models.duffing.system import DUFFING
from magpend_core.models.noisy import noisy
from magpend_core.noisy import noisy_sections
from magpend_core.pointwise import WORTH, evaluate_packed
from magpend_core.sampling import Drive, sample
from tests.core.flows import model_of

N = 75
compiled = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="plain Python runs in one thread")


def some_cells():
    rng = np.random.default_rng(4)
    packed = np.tile([0.2, -1.0, 1.0, 0.3], (N, 1))
    packed[:, 3] = rng.uniform(0.1, 0.5, N)
    return packed, rng.uniform(0.1, 0.3, N), rng.uniform(-1.0, 1.0, (N, 2))


def branches():
    packed, frequency, starts = some_cells()
    # two points each, and branches of different lengths
    both = np.repeat(packed[:, None], 2, axis=1), np.repeat(frequency[:, None], 2, axis=1)
    settings = {"rtol": 1e-8, "atol": 1e-8, "stop_when_closed": True, "system": DUFFING}
    found = run_branches(*both, starts, n_transient=9, n_keep=5, **settings)
    return found.section, found.status, found.n_steps, found.n_rejected, found.final_state, found.step_size


def exponents():
    found = lyapunov_exponents(*some_cells(), n_transient=4, n_periods=16, system=DUFFING)
    return found.exponents, found.weighted, found.blocks, found.status


def samples():
    packed, _, starts = some_cells()
    drives = [Drive(np.full(9, 1 / 0.16)), Drive(np.full(12, 5.0))]
    times = [np.linspace(0.0, 50.0, 30), np.array([0.0, 7.0, 20.0])]
    found = sample(DUFFING, packed, starts, times, piece=np.arange(N) % 2, drives=drives)
    return found.states, found.status, found.n_steps


def with_noise():
    model = noisy(model_of({"x": "a*x - x**3"}, {"a": 1.0}), Disturbance((("x", 0.5),)))
    packed = np.tile(model.load().pack(), (N, 1))
    packed[:, -1] = np.arange(N)
    options = {"seed": 1, "steps_per_period": np.arange(20, 20 + N), "n_transient": 2, "n_keep": 3}
    cells = packed, np.ones(N), np.full((N, 1), 0.2)
    found = noisy_sections(*cells, system=model.system, noise=model.noise, **options)
    return found.section, found.status, found.strong_error


def quantities():
    packed, _, _ = some_cells()
    n = 5 * WORTH * WIDTH
    states, out = np.random.default_rng(1).uniform(-1.0, 1.0, (n, 2)), np.empty((n, len(DUFFING.quantity_names)))
    evaluate_packed(DUFFING, np.linspace(0.0, 5.0, n), states, packed[0], 0.16, out)
    return (out,)


@compiled
@pytest.mark.parametrize("door", [branches, exponents, samples, with_noise, quantities])
def test_doors__same_bytes_with_any_number_of_threads(door):
    found = []
    for n in (1, 2, 3):
        with using_threads(n):
            found.append([array.tobytes() for array in door()])
    assert found[1] == found[0]
    assert found[2] == found[0]


@compiled
def test_take__gives_each_number_to_one_thread():
    @numba.njit(nogil=True)
    def count(queue, counts):
        i = take(queue)
        while i < len(counts):
            counts[i] += 1
            i = take(queue)

    counts = np.zeros(1_000_000, np.int64)
    count(np.array([len(counts)]), counts)  # compiles
    with using_threads(3):
        share(lambda queue, n_lanes: count(queue, counts), len(counts), 64)
    assert (counts == 1).all()
    assert [len(threads_seen(3, n)) for n in (1, WIDTH, WIDTH + 1, 3 * WIDTH, 20 * WIDTH)] == [1, 1, 2, 3, 3]


def threads_seen(n_threads, n_rows):
    """Identities of the threads that work on some rows, none of which may share its own calls again."""
    seen, counts = set(), []
    ready = threading.Barrier(min(n_threads, -(-n_rows // WIDTH)), timeout=20)

    def run(queue, n_lanes):
        ready.wait()
        seen.add(threading.get_ident())
        counts.append((threading.current_thread() is threading.main_thread(), number_of_threads()))

    with using_threads(n_threads):
        share(run, n_rows, 64)
    assert all(count == 1 for is_main, count in counts if not is_main)
    return seen


@compiled
@pytest.mark.parametrize("thrower", ["caller", "helper"])
def test_share__error_surfaces_unchanged_and_ends_the_others(thrower):
    ready, ended = threading.Barrier(2, timeout=20), threading.Event()
    error = ValueError("of a thread")

    def run(queue, n_lanes):
        ready.wait()
        if (threading.current_thread() is threading.main_thread()) == (thrower == "caller"):
            raise error
        while thrower == "caller" and queue[0] < 100:
            pass
        ended.set()

    with using_threads(2), pytest.raises(ValueError, match="of a thread") as raised:
        share(run, 100, 64)
    assert raised.value is error
    assert ended.wait(20)


@compiled
def test_share__interruption_does_not_wait_for_the_others():
    ready, goes_on, ended = threading.Barrier(2, timeout=20), threading.Event(), threading.Event()

    def run(queue, n_lanes):
        ready.wait()
        if threading.current_thread() is threading.main_thread():
            raise KeyboardInterrupt
        goes_on.wait(20)
        ended.set()

    with using_threads(2), pytest.raises(KeyboardInterrupt):
        share(run, 100, 64)
    assert not ended.is_set()
    goes_on.set()
    assert ended.wait(20)


@pytest.mark.slow
@compiled
def test_number_of_threads__from_the_variable(run_python, monkeypatch):
    script = "from magpend_core.engine.threads import number_of_threads; print(number_of_threads())"
    assert run_python(script, MAGPEND_NUM_THREADS="3").strip() == "3"
    threads._default.cache_clear()
    for text in ("0", "-1", "two", "1.5"):
        monkeypatch.setenv(threads.VARIABLE, text)
        with pytest.raises(ValueError, match=f"MAGPEND_NUM_THREADS = '{text}'"):
            number_of_threads()
    monkeypatch.setenv(threads.VARIABLE, "2")
    assert number_of_threads() == 2
    threads._default.cache_clear()
