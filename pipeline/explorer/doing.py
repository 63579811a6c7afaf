"""What is done for each kind of message."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from pipeline.explorer.following import Follower
from pipeline.explorer.jobs import Work
from pipeline.explorer.regions import RegionRunner
from pipeline.explorer.slices import slice_of
from pipeline.explorer.starting import start

if TYPE_CHECKING:
    from pipeline.explorer.live import LiveRun


def works(live: LiveRun) -> Mapping[str, Work]:
    """Return what does each kind of job, with what a session remembers between them."""
    return {
        "start": partial(start, live),
        "slice": partial(slice_of, live),
        "follow": Follower(live).follow,
        "run": RegionRunner(live).run,
    }
