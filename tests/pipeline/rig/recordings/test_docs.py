"""The tutorial's files are valid, and the mapping in it is the one that the virtual rig writes."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from pipeline.rig.recordings.mapping import parse_mapping
from pipeline.rig.virtual import parse_rig, simulated

PAGE = (Path(__file__).parents[4] / "docs" / "rig.md").read_text("utf-8")


def test_docs__rig_and_mapping_belong_together():
    rig, mapping = (tomllib.loads(text) for text in re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)[:2])
    raw, own = simulated(parse_rig(rig))
    assert parse_mapping(mapping) == own
    assert set(raw.stretches[0]) == {"rig/psi1", "rig/psi2", "rig/drive"}
    assert len(raw.stretches[0]["rig/psi1"]) == 11818
