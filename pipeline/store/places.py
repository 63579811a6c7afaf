"""Open the files of a run by path or URL, in a folder or in an object store."""

from __future__ import annotations

from pathlib import Path

from pipeline.store.files import Files, is_url, local_path
from pipeline.store.local import LocalFiles


def open_files(place: str | Path | Files) -> Files:
    """Return the files of a run, given by a folder or a URL such as ``s3://bucket/prefix``.

    `Files` are returned unchanged.

    Raises
    ------
    RefusedError
        If `place` is another URL, or the object store cannot be used.
    """
    if not isinstance(place, (str, Path)):
        return place
    if is_url(place):
        from pipeline.store.objects import parse_url  # an optional dependency

        return parse_url(str(place))
    return LocalFiles(local_path(place))
