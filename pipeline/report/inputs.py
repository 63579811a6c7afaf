"""Define what a kind of input of a study is; plug-ins add the kinds other than runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.specification.tables import Table


@dataclass(frozen=True)
class Input:
    """A kind of input: its table in the study's file, and how it is read and computed."""

    table: type[Table]
    meaning: str  # of the key
    title: str  # of one input, for progress
    read: Callable[[Any, Path], Any]  # its table and the study's folder to what is computed from; raises SpecError
    compute: Callable[[Any, Path], Any]  # what was read and a place for files, without suffix, to the result
