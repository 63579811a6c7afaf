"""Find the stored results of analyses that are valid for the present cells of a run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from pipeline.products.registry import ANALYSES
from pipeline.runs.versions import current
from pipeline.store.errors import DamagedError
from pipeline.store.files import DERIVED
from pipeline.store.products import products_in, read_product_attrs
from pipeline.store.run import RunDirectory


def stored_options(run: RunDirectory, name: str) -> list[dict[str, Any]]:
    """Return the options of each valid stored result of an analysis.

    Parameters
    ----------
    run
        An opened run.
    name
        Name of the analysis.

    Returns
    -------
    list of dict
        Options that differ from their defaults, those with the fewest first.
    """
    found, wanted = [], current(run, name)
    for place in products_in(run.info.files.below(DERIVED)):
        try:
            attrs = read_product_attrs(place)
        except (DamagedError, FileNotFoundError):
            continue
        if all(attrs.get(key) == value for key, value in wanted.items()):
            found.append(settled_options(name, attrs))
    return sorted(found, key=lambda options: (len(options), json.dumps(options, sort_keys=True)))


def settled_options(name: str, attrs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a stored result that differ from their defaults.

    Options that were left open are filled in, such as a range that defaults to the axis'.
    """
    given = json.loads(str(attrs["derived_options"]))
    found: dict[str, Any] = ANALYSES[name].options.model_validate(_tuples(given)).changed()
    return found


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tuples(part) for name, part in value.items()}
    return tuple(_tuples(part) for part in value) if isinstance(value, list) else value
