"""Tasks that go wrong in every way, importable on workers."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path


def log(folder: str, index: int) -> int:
    """Note that a task began, and return how often it has."""
    path = Path(folder) / f"{index}"
    with path.open("a") as file:
        file.write("x")
    return path.stat().st_size


def tries(folder: str | Path) -> dict[int, int]:
    """How often each task began."""
    return {int(path.name): path.stat().st_size for path in Path(folder).iterdir()}


def raising(folder: str, index: int, poison: tuple = (), unlucky: tuple = ()) -> dict:
    """Some tasks always fail, some the first time; all print something."""
    tries = log(folder, index)
    print(index)
    if index in poison or (index in unlucky and tries == 1):
        raise RuntimeError("out of luck")
    return {"task": index}


def deadly(folder: str, index: int, poison: tuple = (), unlucky: tuple = ()) -> dict:
    """Some tasks kill their worker always, some the first time."""
    tries = log(folder, index)
    if index in poison or (index in unlucky and tries == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    return {"task": index}


def hanging(folder: str, index: int, number: int = 0, unlucky: tuple = (), poison: tuple = ()) -> dict:
    """Some tasks stop their worker, or sleep where there is no signal."""
    tries = log(folder, index)
    if index in poison or (index in unlucky and tries == 1):
        if number:
            os.kill(os.getpid(), number)
        time.sleep(600)
    return {"task": index}


def slow(folder: str, index: int, seconds: float = 0.2) -> dict:
    log(folder, index)
    time.sleep(seconds)
    return {"task": index}
