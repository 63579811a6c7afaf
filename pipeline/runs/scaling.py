"""Take the sizes of a run's states from its directory, or find them."""

from __future__ import annotations

from pipeline.layout.scales import with_sizes
from pipeline.specification.spec import Spec
from pipeline.store.errors import DamagedError, RefusedError
from pipeline.store.files import Files
from pipeline.store.runfile import is_run, read_run


def in_scales(spec: Spec, files: Files) -> Spec:
    """Return a specification with the sizes of its states: those that the run in a directory keeps, if there is one."""
    try:
        kept = read_run(files).parsed_spec() if is_run(files) else None
    except (DamagedError, RefusedError, OSError):
        kept = None
    return with_sizes(spec, kept)
