"""Make the tables of the docs on files that describe recordings, rigs and identifications."""

from __future__ import annotations

from pipeline.cli.reference import keys, table


def identification() -> str:
    """Return Markdown tables of the keys of the TOML file that describes an identification."""
    from pipeline.rig.identify import specification as tables
    from pipeline.rig.identify.specification import BifurcationTable, Identified, OrbitsTable

    parts = [
        ("[identify] NAME = {...}", Identified, "NAME is a parameter of the model."),
        ("[sensors]", tables.SensorsTable, ""),
        ("[[recordings]]", tables.RecordingTable, ""),
        ("[[orbits]]", OrbitsTable, "Measured orbits of one branch."),
        ("[[orbits.bifurcations]]", BifurcationTable, ""),
        ("[fit]", tables.FitTable, ""),
        ("[search]", tables.SearchTable, ""),
    ]
    return "\n\n".join(keys(*part) for part in parts)


def mapping() -> str:
    """Return Markdown tables of the keys of the file that describes a recording's channels."""
    from pipeline.rig.recordings import mapping as found

    top = ("csv", "channels", "drive")
    parts = [
        keys("MAPPING.toml", found.Mapping, "", top),
        keys("time = {...}", found.TimeMap, "", ()),
        keys("piece = {...}", found.PieceMap, "", ()),
        keys("[channels.NAME]", found.ChannelMap, "NAME is a state of the model, or a quantity.", ()),
        keys("[drive]", found.DriveMap, 'Or `drive = "none"`.', ()),
        keys("[csv]", found.CsvMap, "For CSV files only; missing keys are detected from the file.", ()),
    ]
    return "\n\n".join(parts)


def findings() -> str:
    """Return the Markdown table of the defects that are searched for in recordings."""
    from pipeline.rig.recordings.channels import KINDS

    return table(("finding", "meaning"), ((f"`{kind}`", meaning) for kind, meaning in KINDS.items()))


def virtual_rig() -> str:
    """Return Markdown tables of the keys of the TOML file that describes a virtual experiment."""
    from pipeline.rig import virtual

    parts = [
        keys("RIG.toml", virtual.RigTable, "", ("drive", "sensors")),
        keys("[drive]", virtual.DriveTable, 'Or `drive = "none"`.', ()),
        keys("sweep = {...}", virtual.SweepTable, "In `[drive]`.", ()),
        keys("[sensors.STATE]", virtual.SensorTable, "", ()),
    ]
    return "\n\n".join(parts)


def measured_branch() -> str:
    """Return Markdown tables of the keys that describe measured branches, and a virtual rig under control."""
    from pipeline.rig.control import ControlTable
    from pipeline.rig.measured.branch import MeasuredBranch, RecordedOrbit

    parts = [
        keys(
            "[measured.branch]", MeasuredBranch, "In the specification of a run, or in a file of its own.", ("orbits",)
        ),
        keys("[[measured.branch.orbits]]", RecordedOrbit, "One for each orbit.", ()),
        keys("[control]", ControlTable, "Beside `model`, `preset` and `parameters`: for `magpend measured trace`.", ()),
    ]
    return "\n\n".join(parts)
