"""Runs from a notebook's kernel and from a script: interrupted, and continued to the same bytes."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.pipeline.factories import n_committed, quietly, wait_for

ROOT = Path(__file__).parents[3]
PATIENCE_S = 240.0
pytestmark = pytest.mark.slow
# the equations of tests/pipeline/runs/test_building.py, which are compiled already
CELL = """
import magpend
model = magpend.model(
    "x' = v\\nv' = -k*x - 0.2*v + A*cos(2*pi*f*t)", name="oscillator", states={"x": "m", "v": "m/s"}, k=1.0, A=0.5
)
spec = (
    magpend.Spec("sweep", model)
    .with_parameters(frequency_hz=0.2)
    .with_axis("A", 0.1, 0.4, 16)
    .with_start_grid(x=(-1, 1, 16))
    .with_integration(n_transient=3000, n_keep=4)
    .with_execution(trajectories_per_task=16)
)
"""
COMPUTE = 'run = magpend.run(spec, "run", workers=2)\n'


@pytest.fixture
def whole(tmp_path, bytes_of):
    """Bytes of the run that was never interrupted."""
    names: dict = {}
    exec(CELL, names)
    quietly(names["spec"], tmp_path / "whole")
    return bytes_of(tmp_path / "whole")


@pytest.fixture
def around(environment):
    return {**environment, "PYTHONPATH": os.pathsep.join([str(ROOT / "pipeline" / "face"), environment["PYTHONPATH"]])}


@pytest.fixture
def kernel(tmp_path, around):
    """Run the code of a cell in a kernel; interrupt it when `when` is true. Returns the messages of its outputs."""
    manager = pytest.importorskip("jupyter_client.manager").KernelManager(kernel_name="python3")
    manager.start_kernel(env=around, cwd=str(tmp_path), stderr=subprocess.DEVNULL)
    client = manager.client()
    client.start_channels()

    def cell(code, when=lambda: False):
        message, outputs, interrupted = client.execute(code), [], False
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end:
            if not interrupted and when():
                interrupted = True
                manager.interrupt_kernel()
            with contextlib.suppress(queue.Empty):
                got = client.get_iopub_msg(timeout=0.02)
                if got["parent_header"].get("msg_id") != message:
                    continue
                if got["content"].get("execution_state") == "idle":
                    return outputs
                outputs.append((got["msg_type"], got["content"]))
        raise AssertionError(outputs)

    try:
        client.wait_for_ready(timeout=PATIENCE_S)
        yield cell
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)
        manager.cleanup_resources()


def test_run__interrupted_in_a_cell_goes_on_with_the_same_cell(kernel, whole, tmp_path, bytes_of):
    stopped = kernel(CELL + COMPUTE + "print('not reached')\n", lambda: n_committed(tmp_path / "run") >= 2)
    kind, content = stopped[-1]
    assert (kind, content["ename"]) == ("error", "KeyboardInterrupt")
    assert content["traceback"] == ["Stopped. The finished cells stay in run; the same call goes on from there."]
    assert not any("not reached" in content["text"] for kind, content in stopped if kind == "stream")
    before = n_committed(tmp_path / "run")
    assert 2 <= before < 16
    again = kernel(CELL + COMPUTE + "print('complete:', run.complete)\n")
    assert [content["text"] for kind, content in again if kind == "stream"][-1].endswith("complete: True\n")
    assert bytes_of(tmp_path / "run") == whole
    # one bar, whose last state has all cells, and few lines
    bars = [content["transient"]["display_id"] for kind, content in again if "display" in kind]
    assert len(set(bars)) == 1
    last = [content["data"] for kind, content in again if "display" in kind][-1]
    assert last["text/plain"].startswith("computing cells: 256 of 256 (100 %), done after")
    assert "<progress max='256' value='256'" in last["text/html"]


@pytest.mark.parametrize("scheduler", ["threads", "processes"])
def test_run__interrupted_in_a_script_goes_on_with_the_same_script(around, whole, tmp_path, bytes_of, scheduler):
    """The script has no ``if __name__ == "__main__"``: processes do not run it."""
    script, compute = tmp_path / "script.py", COMPUTE.replace("=2", f"=2, scheduler={scheduler!r}")
    script.write_text(f"print('begun', flush=True)\n{CELL}{compute}print('complete:', run.complete)\n", "utf-8")

    def begin():
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
        heed = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)  # noqa: E731
        return subprocess.Popen([sys.executable, script], cwd=tmp_path, env=around, preexec_fn=heed, **pipes)

    process = begin()
    try:
        wait_for(lambda: n_committed(tmp_path / "run") >= 2, process)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
    assert process.returncode == -signal.SIGINT, err
    assert err.splitlines()[-1].endswith("Stopped. The finished cells stay in run; the same call goes on from there.")
    assert out.count("begun") == 1
    assert "complete" not in out
    assert 2 <= n_committed(tmp_path / "run") < 16
    process = begin()
    out, err = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, out.count("begun"), "complete: True" in out) == (0, 1, True), err
    assert bytes_of(tmp_path / "run") == whole
