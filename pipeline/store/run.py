"""What stands in a run directory, opened once: specification, plan, commits and cube."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.layout.plan import Plan, make_plan
from pipeline.spec.parsing import Spec, parse_spec
from pipeline.store import directory as store

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Run:
    """A run directory with what was committed at one moment, so that all results speak of the same cells."""

    info: store.RunInfo
    spec: Spec
    plan: Plan
    commits: Mapping[int, store.Commit]

    @classmethod
    def open(cls, source: str | Path | Run) -> Run:
        """Return what stands in a run directory now; an opened run is returned as it is."""
        if isinstance(source, Run):
            return source
        info = store.read_run(Path(source))
        spec = parse_spec(info.spec)
        plan = make_plan(spec)
        return cls(info, spec, plan, store.read_commits(info, plan))

    @property
    def directory(self) -> Path:
        """Where it is."""
        return self.info.directory

    @cached_property
    def digest(self) -> str:
        """Digest of the committed cells."""
        return store.cube_digest(self.info, self.commits)

    def cube(self, chunks: Any = None) -> xr.Dataset:
        """Open the cube, as `pipeline.open_run` does."""
        from pipeline.store.reading import open_committed

        return open_committed(self.info, self.plan, self.commits, chunks=chunks)
