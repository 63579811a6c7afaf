"""Names of the run directory in one place, for those who want many of them."""

from pipeline.store.commits import (
    Commit,
    Verification,
    cube_digest,
    log_timing,
    marker_path,
    read_commits,
    sweep,
    verify,
    withdraw,
    write_task,
)
from pipeline.store.errors import (
    DamagedError,
    IncompleteError,
    LockedError,
    RefusedError,
    StoreError,
    UnreadableError,
)
from pipeline.store.files import DERIVED, writer_lock
from pipeline.store.products import (
    SEAL,
    leftover_products,
    open_product,
    product_paths,
    read_product_attrs,
    remove_product,
    write_product,
)
from pipeline.store.runfile import RunInfo, is_run, read_run
from pipeline.store.setup import check, create, establish
from pipeline.store.view import CommittedStore, committed_view

__all__ = [
    "DERIVED",
    "SEAL",
    "Commit",
    "CommittedStore",
    "DamagedError",
    "IncompleteError",
    "LockedError",
    "RefusedError",
    "RunInfo",
    "StoreError",
    "UnreadableError",
    "Verification",
    "check",
    "committed_view",
    "create",
    "cube_digest",
    "establish",
    "is_run",
    "leftover_products",
    "log_timing",
    "marker_path",
    "open_product",
    "product_paths",
    "read_commits",
    "read_product_attrs",
    "read_run",
    "remove_product",
    "sweep",
    "verify",
    "withdraw",
    "write_product",
    "write_task",
    "writer_lock",
]
