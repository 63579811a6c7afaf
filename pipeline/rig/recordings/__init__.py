"""Read recordings of a rig: read files, map channels to states, report faults, and estimate rates by smoothing."""

from pipeline.rig.recordings.channels import Finding, findings_of, summary
from pipeline.rig.recordings.mapping import Mapping, load_mapping, parse_mapping
from pipeline.rig.recordings.reading import read_recording, recording_of, window
from pipeline.rig.recordings.smoothing import smooth
from pipeline.rig.recordings.writing import mapping_for, write_raw, write_recording

__all__ = [
    "Finding",
    "Mapping",
    "findings_of",
    "load_mapping",
    "mapping_for",
    "parse_mapping",
    "read_recording",
    "recording_of",
    "smooth",
    "summary",
    "window",
    "write_raw",
    "write_recording",
]
