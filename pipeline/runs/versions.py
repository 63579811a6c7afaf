"""Tell which stored results of analyses hold: the versions that decide them, and the attractors that they rest on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping

from magpend_core.versions import ENGINE
from pipeline.analysis.attractors.declaration import AttractorOptions
from pipeline.products.product import Analysis, Options
from pipeline.products.registry import ANALYSES
from pipeline.store.errors import DamagedError
from pipeline.store.files import DERIVED
from pipeline.store.run import RunDirectory

OF_ATTRACTORS = "attractors.json"


def version_of(name: str) -> str:
    """Return the numbers that decide the results of an analysis: of the engine, and of what it builds on."""
    own = {one: ANALYSES[one].version for one in sorted(_parts(name))}
    return ", ".join(f"{part} {number}" for part, number in {"engine": ENGINE, **own}.items())


def _parts(name: str) -> set[str]:
    return {name}.union(*(_parts(other) for other in ANALYSES[name].builds_on))


def attractor_options(run: RunDirectory) -> AttractorOptions:
    """Return the options of the run's attractors: those last given, or the defaults."""
    try:
        return AttractorOptions.model_validate_json(run.info.files.below(DERIVED).read(OF_ATTRACTORS))
    except FileNotFoundError:
        return AttractorOptions()
    except ValueError:
        raise DamagedError(f"{run.name}: {DERIVED}/{OF_ATTRACTORS} is damaged; remove it.") from None


def current(run: RunDirectory, name: str) -> dict[str, str]:
    """Return the attributes of those results of an analysis that hold for the present cells and attractors of a run."""
    rests = rests_on_attractors(name)
    options = json.dumps(attractor_options(run).changed(), sort_keys=True) if rests else ""
    found = {"derived_product": name, "cube_digest": run.digest, "analysis_version": version_of(name)}
    return {**found, "attractor_options": options}


def rests_on_attractors(name: str) -> bool:
    """Return whether an analysis takes the run's attractors as they are."""
    return any(one == "attractors" or rests_on_attractors(one) for one in ANALYSES[name].builds_on)


def key_of(current: Mapping[str, str], analysis: Analysis, options: Options) -> dict[str, str]:
    """Return the attributes of a result that hold everything which decides its numbers.

    Parameters
    ----------
    current
        What holds for the present cells and attractors of the run, see `current`.
    analysis, options
        The analysis with its options.
    """
    plain = {name: value for name, value in options.plain().items() if name not in analysis.ignores}
    parts = {**current, "derived_options": json.dumps(plain, sort_keys=True)}
    return {**parts, "derived_key": hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()}
