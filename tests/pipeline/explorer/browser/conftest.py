"""A real browser before a real explorer: chromium by playwright, a small run, its page served on loopback.

The run is computed once and served once; `browser` starts chromium once for each file of tests: playwright's
event loop counts as running in its thread while it is there, so that it must end before other tests begin.
Where there is no chromium or no playwright the tests say so and are skipped.

Loading the page is what takes long: tests that leave it as they find it but for what it shows have `reused`
open it once, and what it shows put back.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from pipeline.runs.derive import derive
from tests.pipeline.factories import finished

ROOT = Path(__file__).parents[4]

HOSTILE = "small <img src=x onerror=\"document.title='run by a title'\"> run"
"""A title that would run what it says if it were ever taken for markup."""

SMALL = f"""
kind = "sweep"
title = {json.dumps(HOSTILE)}
axes = {{ frequency_hz = {{ start = 2.2, stop = 2.3, num = 5 }} }}
initial_conditions.kind = "grid"
initial_conditions.psi1_deg = {{ start = -20, stop = 20, num = 3 }}
initial_conditions.psi2_deg = {{ start = -20, stop = 20, num = 3 }}
integration = {{ rtol = 1e-7, atol = 1e-7, n_transient = 300, n_keep = 20 }}
"""

CANDIDATES = ("/usr/bin/chromium", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable")

WAIT_MS = 60_000  # a machine that is busy with other tests
ENDING_S = 60.0  # what a server may take to end after SIGTERM


def chromium() -> str | None:
    """Path of a chromium, if there is one."""
    return next((found for name in CANDIDATES if (found := shutil.which(name))), None)


@dataclass
class Opened:
    """A page, its errors of the console, of scripts and of requests, and its requests to other hosts."""

    page: Any
    complaints: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)

    def watch(self, host: str) -> None:
        """Collect from now on."""

        def console(message: Any) -> None:
            if message.type in ("error", "warning"):
                self.complaints.append(f"{message.type}: {message.text}")

        def request(asked: Any) -> None:
            if not asked.url.startswith((f"http://{host}", f"ws://{host}", "data:", "blob:", "file:")):
                self.outside.append(asked.url)

        self.page.on("console", console)
        self.page.on("pageerror", lambda error: self.complaints.append(f"script: {error}"))
        self.page.on("requestfailed", lambda asked: self.complaints.append(f"request: {asked.url} {asked.failure}"))
        self.page.on("request", request)


@pytest.fixture(scope="session")
def looked_at(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory of a small run of the pendulum whose attractors have been analysed."""
    directory = finished(tmp_path_factory.mktemp("looked-at"), SMALL)
    derive(directory, "attractors", {})
    return directory


@contextmanager
def served(directory: Path, *words: str) -> Iterator[str]:
    """Serve the page of a run in a process of its own; gives its address."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "pipeline.cli.main", "explore", str(directory), "--no-browser", *words]
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        try:
            address = next((line.strip() for line in process.stdout if line.startswith("http://")), None)
            assert address is not None, f"magpend explore ended with {process.wait()}"
            yield address
        finally:
            process.terminate()
            try:
                process.wait(ENDING_S)
            except subprocess.TimeoutExpired:
                process.kill()
                raise


@pytest.fixture(scope="session")
def explorer(looked_at: Path) -> Iterator[str]:
    """Address of the explorer that shows `looked_at`."""
    with served(looked_at) as address:
        yield address


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium, once for each file of tests."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    path = chromium()
    if path is None:
        pytest.skip("there is no chromium on this machine")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield started
        started.close()


def visiting(browser: Any) -> Iterator[Callable[..., Opened]]:
    """Open an address in a window of its own: ``visit(address, width=1440, height=900, **context)``."""
    contexts = []

    def go(address: str, width: int = 1440, height: int = 900, **options: Any) -> Opened:
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        context.set_default_timeout(WAIT_MS)
        opened = Opened(context.new_page())
        opened.watch(address.split("/")[2])
        opened.page.goto(address)
        return opened

    yield go
    for context in contexts:
        context.close()


def drawn(opened: Opened) -> Opened:
    """Wait until the diagram of a page is there."""
    opened.page.wait_for_selector(".diagram[data-drawn]")
    until(opened.page, "window.magpend && !document.querySelector('.diagram[aria-busy]')")
    return opened


def until(page: Any, expression: str) -> None:
    """Wait until an expression is true in the page, whose policy stops playwright's own waiting."""
    end = time.monotonic() + WAIT_MS / 1000.0
    while not page.evaluate(expression):
        assert time.monotonic() < end, f"still not so: {expression}"
        page.wait_for_timeout(20)


@pytest.fixture
def visit(browser: Any) -> Iterator[Callable[..., Opened]]:
    """See `visiting`; what is opened ends with the test."""
    yield from visiting(browser)


@pytest.fixture(scope="module")
def lasting(browser: Any) -> Iterator[Callable[..., Opened]]:
    """See `visiting`; what is opened stays for all tests of a file."""
    yield from visiting(browser)


@contextmanager
def reused(opened: Opened) -> Iterator[Opened]:
    """Give a page to a test, and put back what it showed before; it complains of nothing in between."""
    begun = opened.page.evaluate("magpend.state.get()")
    yield opened
    opened.page.mouse.move(5, 5)
    opened.page.evaluate("begun => { document.activeElement?.blur(); magpend.state.set(begun); }", begun)
    until(opened.page, "!document.querySelector('.diagram[aria-busy]')")
    assert opened.page.evaluate("magpend.state.get()") == begun
    assert opened.complaints == []
