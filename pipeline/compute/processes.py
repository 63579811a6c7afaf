"""Run tasks in processes of this machine: a task that crashes, or is killed for its memory, takes nothing else along.

Each thread of `pipeline.compute.threads` starts a process and talks to it through pipes, which nobody else can reach.
A process reads tasks from its standard input. When that ends, however this process ended, it ends too.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import subprocess
import sys
import threading
from queue import SimpleQueue
from typing import Any, NoReturn

from pipeline.compute.order import why
from pipeline.compute.threads import Task


class ProcessError(Exception):
    """Raised if a task failed in its process, or if the process died."""


class _Process(subprocess.Popen[bytes]):
    """Child that answers one thread; any thread may end it."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._asked = threading.Lock()

    def ask(self, task: bytes, index: int) -> tuple[dict[str, Any], str]:
        assert self.stdin
        assert self.stdout
        with self._asked:
            pickle.dump((task, index), self.stdin)
            self.stdin.flush()
            result, reason = pickle.load(self.stdout)
        return result, reason

    def end(self) -> None:
        self.kill()
        self.wait()
        with self._asked:  # closing a pipe takes its buffer from a thread that still reads
            for pipe in (self.stdin, self.stdout):
                with contextlib.suppress(OSError):  # a request may not have left the buffer
                    pipe.close()  # type: ignore[union-attr]


class Processes:
    """Task that each thread runs in its own child process; a process that dies is replaced.

    A process does not import the main module, so a script needs no ``if __name__ == "__main__"``.
    """

    def __init__(self, task: Task) -> None:
        self._task = pickle.dumps(task)
        self._own = threading.local()
        self._started: list[_Process] = []
        self._lock = threading.Lock()
        self._is_closed = False

    def __call__(self, index: int) -> dict[str, Any]:
        """Run the task in the process of this thread; raise `ProcessError` if it fails there, or the process dies."""
        process: _Process = getattr(self._own, "process", None) or self._start()
        try:
            result, reason = process.ask(self._task, index)
        except (OSError, EOFError, pickle.UnpicklingError):
            self._own.process = None
            process.end()
            raise ProcessError("its process died (out of memory, or killed)") from None
        if reason:
            raise ProcessError(reason)
        return dict(result)

    def _start(self) -> _Process:
        # the same folders, also those that were added since the start of Python
        code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; serve()"
        with self._lock:
            if self._is_closed:
                raise ProcessError("the run has ended")
            self._own.process = process = _Process(
                [sys.executable, "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C in the terminal is for this process alone
            )
            self._started.append(process)
        return process

    def close(self) -> None:
        """Kill all processes, without waiting for their tasks."""
        with self._lock:
            self._is_closed = True
        for process in self._started:
            process.end()


def serve() -> NoReturn:
    """Answer pickled tasks with their index by the result and the reason of a failure, until the input ends."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a task prints must not get among the answers
    logging.disable()  # the process that sends the tasks says the same
    requests: SimpleQueue[tuple[bytes, int]] = SimpleQueue()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()
    while True:
        task, index = requests.get()
        try:
            answer = pickle.loads(task)(index), ""
        except Exception as error:
            answer = {}, why(error)
        pickle.dump(answer, answers)
        answers.flush()


def _listen(requests: SimpleQueue[tuple[bytes, int]]) -> None:
    """Read requests beside the running task, so that the end of the input ends this process at once."""
    with contextlib.suppress(EOFError):
        while True:
            requests.put(pickle.load(sys.stdin.buffer))
    os._exit(0)
