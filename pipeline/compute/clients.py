"""Clients of dask: of a local cluster, or of a scheduler that exists already."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from pipeline.compute.local import local_cluster

ALLOWED_FAILURES = 3
"""Worker deaths that a task may be blamed for: one would blame innocent tasks."""


@contextlib.contextmanager
def connected(address: str | None, n_workers: int) -> Iterator[Any]:
    """Yield a client of the scheduler at `address`, or of a new local cluster."""
    import dask
    from distributed import Client

    settings = {"distributed.scheduler.allowed-failures": ALLOWED_FAILURES}
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        if address is None:
            address = stack.enter_context(local_cluster(n_workers))
        yield stack.enter_context(Client(address, set_as_default=False))  # type: ignore[no-untyped-call]
