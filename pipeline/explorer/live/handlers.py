"""Map each kind of message to the function that handles it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from pipeline.explorer.live.jobs import Work
from pipeline.explorer.live.orbit_following import Follower
from pipeline.explorer.live.regions import RegionRunner
from pipeline.explorer.live.slices import slice_of
from pipeline.explorer.live.starting import start

if TYPE_CHECKING:
    from pipeline.explorer.live.live import LiveRun


def works(live: LiveRun) -> Mapping[str, Work]:
    """Return the function that handles each kind of job of a session."""
    return {
        "start": partial(start, live),
        "slice": partial(slice_of, live),
        "follow": Follower(live).follow,
        "run": RegionRunner(live).run,
    }
