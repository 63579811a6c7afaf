"""Recordings of a rig: files, their mapping to states, what is wrong with them, their rates."""

from pipeline.rig.recordings.findings import Finding, findings_of
from pipeline.rig.recordings.mapping import Mapping, load_mapping, parse_mapping
from pipeline.rig.recordings.reading import read_recording, window

__all__ = ["Finding", "Mapping", "findings_of", "load_mapping", "parse_mapping", "read_recording", "window"]
