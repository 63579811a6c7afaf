"""Small specifications, runs without the kernel, and subprocesses for the pipeline's tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.pipeline.factories import result_of

ROOT = Path(__file__).parents[2]

SWEEP = """
kind = "sweep"
title = "small sweep"
[axes]
frequency_hz = { start = 2.0, stop = 3.0, num = 5 }
q = { values = [1.5, 1.6] }
[initial_conditions]
kind = "grid"
psi1_deg = { start = -30, stop = 30, num = 3 }
psi2_deg = { start = -20, stop = 20, num = 4 }
psi1_dot = 0.1
[integration]
rtol = 1e-6
atol = 1e-6
n_transient = 2
n_keep = 3
[execution]
trajectories_per_task = 24
"""

WALK = """
kind = "continuation"
title = "small continuation"
[axes]
frequency_hz = { start = 2.0, stop = 2.5, num = 6 }
[initial_conditions]
kind = "random"
n = 5
seed = 3
psi1_deg = [-40, 40]
psi2_deg = [-40, 40]
[continuation]
direction = "both"
[integration]
rtol = 1e-6
atol = 1e-6
n_transient = 4
n_keep = 3
[execution]
trajectories_per_task = 5
points_per_task = 4
"""


@pytest.fixture(scope="module", autouse=True)  # of a whole session, it would reach tests beside this folder
def _results_are_read_by_others():
    """Let cf-xarray and pint-xarray read every result of an analysis that any test derives."""
    if any(find_spec(name) is None for name in ("cf_xarray", "pint_xarray")):
        yield
        return
    import cf_xarray  # noqa: F401
    import pint_xarray  # noqa: F401

    from pipeline.runs import derive

    original = derive._placed

    def placed(stored, place):
        ds = original(stored, place)
        ds.pint.quantify()
        assert all(ds[name].attrs["long_name"] for name in ds.variables)
        assert ds.cf.axes is not None
        return ds

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(derive, "_placed", placed)
        yield


@pytest.fixture
def sweep_text() -> str:
    return SWEEP


@pytest.fixture
def walk_text() -> str:
    return WALK


@pytest.fixture
def write_spec(tmp_path):
    """Write a specification and return its path."""

    def write(text: str, name: str = "spec.toml") -> Path:
        path = tmp_path / name
        path.write_text(text, "utf-8")
        return path

    return write


@pytest.fixture
def bytes_of():
    """All files of a run that must not depend on how it was run."""
    return result_of


@pytest.fixture
def made(tmp_path, write_spec, sweep_text):
    """A run directory set up from the small sweep, with made-up numbers to commit."""
    from pipeline.layout.plan import make_plan
    from pipeline.specification.spec import Spec
    from pipeline.store.setup import create
    from pipeline.store.tasks import write_task

    path = write_spec(sweep_text)
    spec = Spec.read(path)
    plan = make_plan(spec, sweep_text)
    info = create(tmp_path / "run", plan)

    def values(index: int) -> dict[str, np.ndarray]:
        shape = tuple(s.stop - s.start for s in plan.task(index))
        sizes = plan.sizes
        rng = np.random.default_rng(index)
        made_up = {}
        for v in plan.variables:
            numbers = rng.uniform(1, 5, (*shape, *(sizes[d] for d in v.own_dims)))
            made_up[v.name] = numbers.astype(v.dtype)
        made_up["status"][...] = 2
        made_up["orbit_period"][...] = 0  # the fill value: must be written all the same
        return made_up

    def commit(index: int) -> None:
        write_task(info, index, values(index), {"bounded": plan.cells_in(index)})

    return SimpleNamespace(info=info, plan=plan, spec=spec, values=values, commit=commit)


@pytest.fixture
def environment(tmp_path):
    """Environment of subprocesses: this source tree, and temporary files that go with the test."""
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    return {**os.environ, "PYTHONPATH": path, "TMPDIR": str(scratch)}


@pytest.fixture
def magpend(tmp_path, environment):
    """Run the command line in a process of its own."""

    def call(*arguments, **options):
        return subprocess.run(
            [sys.executable, "-m", "pipeline.cli.main", *map(str, arguments)],
            cwd=options.pop("cwd", tmp_path),
            env=environment,
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
            **options,
        )

    return call


def _heed_signals() -> None:
    """Undo what runs the tests, which may ignore signals as `nohup` does; processes inherit that."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


@pytest.fixture
def start(tmp_path, environment):
    """Start the command line in a session of its own; whatever is left at the end is killed."""
    running = []

    def begin(*arguments):
        process = subprocess.Popen(
            [sys.executable, "-m", "pipeline.cli.main", *map(str, arguments)],
            cwd=tmp_path,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=_heed_signals,
        )
        running.append(process)
        return process

    yield begin
    for process in running:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


@pytest.fixture
def main(monkeypatch, tmp_path, capsys):
    """Call the command line in this process; returns exit code, output and errors."""
    from pipeline.cli.main import main as entry

    def call(*arguments):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["magpend", *map(str, arguments)])
        code = 0
        try:
            entry()
        except SystemExit as end:
            code = int(end.code or 0)
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.fixture(scope="session")
def computed(tmp_path_factory):
    """Compute a specification, each one once, and return its run directory, which nobody may change."""
    from pipeline.runs.run import run

    directories: dict[str, Path] = {}

    def call(spec) -> Path:
        key = str(spec)
        if key not in directories:
            directories[key] = tmp_path_factory.mktemp("computed") / "run"
            run(spec, directories[key], workers=0, echo=lambda line: None)
        return directories[key]

    return call


# ---- systems of one's own ----------------------------------------------------------------------

OWN_TEXT = """
[model]
name = "duffing5"
states = { x = { unit = "m" }, v = { unit = "m/s" } }
parameters = { d = 0.08, A = { value = 0.2, unit = "N", meaning = "amplitude" } }
define = { drive = "A*cos(2*pi*f*t)" }
equations = { x = "v", v = "drive - d*v - x**3" }
"""

OWN_GRID = """
kind = "sweep"
title = "five attractors"
{model}
[parameters]
frequency_hz = 0.15915494309189535
[initial_conditions]
kind = "grid"
x = {{ start = -1.0, stop = 1.0, num = 6 }}
v = {{ start = -0.5, stop = 1.0, num = 4 }}
[integration]
rtol = 1e-7
atol = 1e-7
n_transient = 20
n_keep = 4
[execution]
trajectories_per_task = 8
{more}
"""

OWN_MODULE = '''
"""A damped oscillator under a cosine, x'' + d x' + x = cos(2 pi f t)."""

from pathlib import Path

from magpend_core.engine.jit import inline
from magpend_core.engine.system import System
from magpend_core.engine.vecmath import TWO_PI, sincos
from magpend_core.models.model import Mirror, Model, Preset, Quantity, State
from magpend_core.models.parameters import NON_NEGATIVE, Parameter

with Path(__file__).with_name("imported").open("a") as trace:
    trace.write("x")


@inline
def constants(frequency, p, out):
    out[0] = p[0]
    out[1] = TWO_PI * frequency


@inline
def forcing(t, c):
    return sincos(c[1] * t)[1]


@inline
def rhs(y, u, c):
    return y[1], u - c[0] * y[1] - y[0]


@inline
def jacobian(y, u, c):
    zero = 0.0 * y[0]
    return zero, zero + 1.0, zero - 1.0, zero - c[0]


SYSTEM = System(
    name="mine", state_names=("x", "v"), parameter_names=("d",), n_constants=2,
    constants=constants, forcing=forcing, rhs=rhs, jacobian=jacobian,
)
MINE = Model(
    name="mine",
    title="an oscillator of one's own",
    states=(State("x", "m", "place", rate="v"), State("v", "m/s", "velocity", escape=1e6)),
    parameters=(Parameter("d", "1/s", "damping", NON_NEGATIVE),),
    presets=(Preset("light", {"d": 0.1}, {"d": "chosen"}), Preset("heavy", {"d": 0.5}, {"d": "chosen"})),
    system_path=f"{__name__}:SYSTEM",
    sources=(),
    section="the drive's maximum",
    mirror=Mirror((-1, -1), half_period=True),
)
'''


@pytest.fixture(scope="session")
def own():
    """A system of one's own, as text and as a Python module that leaves a trace when it is imported."""

    def spec(model: str, more: str = "") -> str:
        """A small sweep; `model` is a line, or a table, which goes last."""
        is_table = model.lstrip().startswith("[")
        line, end = ("", f"{more}\n{model}") if is_table else (model, more)
        return OWN_GRID.format(model=line, more=end)

    def write_module(folder: Path, name: str) -> Path:
        """Write the module, and return the file that it leaves when it is imported."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.py").write_text(OWN_MODULE, "utf-8")
        return folder / "imported"

    return SimpleNamespace(text=OWN_TEXT, spec=spec, write_module=write_module)
