"""Tell which stored results of analyses hold: by the versions that decide them, and what they rest on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from magpend_core.versions import ENGINE
from pipeline.products.product import Analysis, Options
from pipeline.products.registry import ANALYSES
from pipeline.runs.choices import Choices, changed_branches
from pipeline.store.run import RunDirectory


def version_of(name: str) -> str:
    """Return the numbers that decide the results of an analysis: of the engine, and of what it builds on."""
    own = {one: ANALYSES[one].version for one in sorted(_parts(name))}
    return ", ".join(f"{part} {number}" for part, number in {"engine": ENGINE, **own}.items())


def _parts(name: str) -> set[str]:
    """Return an analysis and all that it builds on; two may build on each other, each with other options."""
    found: set[str] = set()
    left = [name]
    while left:
        one = left.pop()
        if one not in found:
            found.add(one)
            left += ANALYSES[one].builds_on
    return found


def current(run: RunDirectory, name: str, options: Mapping[str, Any]) -> dict[str, str]:
    """Return the attributes that a result must have to be valid for the present cells, attractors and branches.

    Parameters
    ----------
    run
        The run.
    name
        The analysis.
    options
        Options of the result. They name the parameter of the branches on which it rests; without, all count.
    """
    found = {"derived_product": name, "cube_digest": run.digest, "analysis_version": version_of(name)}
    is_on_sets, is_on_branches = (rests_on(name, one) for one in ("attractors", "branches"))
    attractors = json.dumps(Choices.of(run).attractors.changed(), sort_keys=True) if is_on_sets else ""
    branches = {"branch_options": changed_branches(run, options.get("parameter"))} if is_on_branches else {}
    return {**found, "attractor_options": attractors, **branches}


def rests_on(name: str, chosen: str) -> bool:
    """Return whether an analysis takes the run's attractors, or branches, as they are."""
    return chosen != name and chosen in _parts(name)


def key_of(current: Mapping[str, str], analysis: Analysis, options: Options) -> dict[str, str]:
    """Return the attributes of a result that hold everything which decides its numbers.

    Parameters
    ----------
    current
        What holds for the present state of the run, see `current`.
    analysis, options
        The analysis with its options.
    """
    plain = {name: value for name, value in options.plain().items() if name not in analysis.ignores}
    parts = {**current, "derived_options": json.dumps(plain, sort_keys=True)}
    return {**parts, "derived_key": hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()}
