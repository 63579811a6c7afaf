"""Variants of a specification: other starts, lengths and tolerances, one changed at a time."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Iterator, Mapping
from typing import Any

from tests.zoo.answers import SYSTEMS

OWN = "own"

LENGTHS = (20, 60, 300)
"""Of `n_keep`."""

TRANSIENTS = {"transient/3": 1 / 3, "transient*3": 3.0}
TOLERANCES = (1e-6, 1e-8, 1e-10)
STARTS = ("other starts", "more starts")


def load(name: str) -> dict[str, Any]:
    """Read a system's specification, with the text of its model in place of the model's file."""
    data = tomllib.loads((SYSTEMS / f"{name}.toml").read_text("utf-8"))
    model = data["model"]
    if isinstance(model, str) and model.endswith(".toml"):
        data["model"] = tomllib.loads((SYSTEMS / model).read_text("utf-8"))
    return data


def settings(data: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the specification itself, then its variants, each with a name."""
    yield OWN, copy.deepcopy(dict(data))
    for word in STARTS:
        yield word, {**data, "initial_conditions": _started(data["initial_conditions"], word)}
    given = data["integration"]
    changes: list[tuple[str, dict[str, Any]]] = [(f"keep {n}", {"n_keep": n}) for n in LENGTHS]
    changes += [(w, {"n_transient": round(given["n_transient"] * c)}) for w, c in TRANSIENTS.items()]
    changes += [(f"tolerance {t:g}", {"rtol": t, "atol": t}) for t in TOLERANCES]
    for word, change in changes:
        if any(given[key] != value for key, value in change.items()):
            yield word, {**data, "integration": {**given, **change}}


def _started(given: Mapping[str, Any], word: str) -> dict[str, Any]:
    """Return other starts in the same box: another seed or a shifted grid; or half as many again."""
    if given["kind"] == "random":
        more = {"n": given["n"] * 3 // 2} if word == STARTS[1] else {}
        return {**given, **more, "seed": given["seed"] + 100}
    grid = dict(given)
    for state, side in given.items():
        if not isinstance(side, dict):
            continue
        if word == STARTS[1]:
            grid[state] = {**side, "num": side["num"] * 5 // 4 + 1}
            continue
        shift = 0.37 * (side["stop"] - side["start"]) / (side["num"] - 1)
        grid[state] = {**side, "start": side["start"] + shift, "stop": side["stop"] + shift}
    return grid
