"""Choose the function that handles each kind of message from the page."""

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
    """Return the function that does each kind of live job, by the kind's name."""
    return {
        "start": partial(start, live),
        "slice": partial(slice_of, live),
        "follow": Follower(live).follow,
        "run": RegionRunner(live).run,
    }
