"""A cluster of this machine's cores, which lives as long as the run."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import tempfile
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def local_cluster(n_workers: int, *, dashboard: bool = False) -> Iterator[Any]:
    """Yield a cluster of single-threaded processes, reachable from this machine alone."""
    from distributed import LocalCluster

    with (
        tempfile.TemporaryDirectory(prefix="magpend-", ignore_cleanup_errors=True) as scratch,
        LocalCluster(  # type: ignore[no-untyped-call]
            n_workers=n_workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            # The scheduler serves HTTP even without a dashboard: by default at port 8787, with a
            # warning if another run is there.
            scheduler_kwargs={"dashboard": dashboard, "dashboard_address": "127.0.0.1:0"},
            local_directory=scratch,
            silence_logs=50,
        ) as cluster,
    ):
        try:
            yield cluster
        except BaseException:
            _kill(cluster)
            raise


def _kill(cluster: Any) -> None:
    """End the workers at once: what they are computing is given up, and may take long.

    dask then logs each connection that it misses, some after the cluster has closed; the exception that
    led here says what happened.
    """
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)
