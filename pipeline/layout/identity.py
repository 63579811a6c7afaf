"""What makes two runs the same run: a digest, and the difference key by key."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from typing import Any

from pipeline.layout.plan import Plan
from pipeline.layout.schema import FORMAT, REFINEMENT
from pipeline.spec.parsing import Spec


def identity_of(spec: Spec, plan: Plan, kernel_version: str) -> dict[str, Any]:
    """Return all that decides the store's bytes: specification, parameter values, layout, kernel.

    The title and ``[execution]`` are left out; the layout that the latter leads to is in.
    """
    tables = {k: v for k, v in spec.as_dict().items() if k not in ("title", "execution")}
    return {
        **({} if spec.refine is None else {"refinement": REFINEMENT}),
        "format": FORMAT,
        "kernel_version": kernel_version,
        "spec": tables,
        "model_digest": spec.model.digest,
        "parameter_values": spec.values.as_dict(),
        "chunks": {v.name: list(plan.chunks(v)) for v in plan.variables},
    }


def canonical(data: Any) -> str:
    """One text for equal data: sorted keys, shortest numbers that read back the same."""
    return json.dumps(data, sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def digest_of(identity: Mapping[str, Any]) -> str:
    """Digest of an identity, 32 hexadecimal digits."""
    return hashlib.sha256(canonical(_numbers(identity)).encode()).hexdigest()[:32]


def _numbers(data: Any) -> Any:
    """Make ``2`` and ``2.0`` the same."""
    if isinstance(data, Mapping):
        return {k: _numbers(v) for k, v in data.items()}
    if isinstance(data, (list, tuple)):
        return [_numbers(v) for v in data]
    return float(data) if isinstance(data, int) and not isinstance(data, bool) else data


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """Return a line per key that differs: dotted path, value in the directory, value now."""
    left, right = dict(_leaves(_numbers(old))), dict(_leaves(_numbers(new)))
    absent = "(absent)"
    return [
        f"{key}: {left.get(key, absent)!s} in the directory, {right.get(key, absent)!s} now"
        for key in dict.fromkeys((*left, *right))
        if left.get(key, absent) != right.get(key, absent)
    ]


def _leaves(data: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
