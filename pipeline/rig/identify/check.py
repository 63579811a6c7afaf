"""Test a finished identification on another recording. Only the initial states of the recording's pieces are fitted."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from magpend_core.models import load_model
from magpend_core.models.model import Parameters
from pipeline.rig.identify.build import drive_problems, pieces_of
from pipeline.rig.identify.directory import read_info, read_result
from pipeline.rig.identify.identification import require_starts
from pipeline.rig.identify.judging import judge
from pipeline.rig.identify.problem import Free, Problem
from pipeline.rig.identify.settings import apply_settings
from pipeline.rig.identify.specification import RecordingTable
from pipeline.rig.recordings import parse_mapping, read_recording, smooth
from pipeline.specification.problems import SpecError


def check(directory: str | Path, recording: str | Path, *, like: int = 0) -> dict[str, Any]:
    """Test a finished identification on another recording; return the residuals' rms and the correlation by channel.

    The file's pieces stay whole, and each has a free start. Every sample counts. The criterion is least
    squares, whatever the loss of the fit. Sensors' zeros keep their identified values.

    Parameters
    ----------
    directory
        Directory of a finished identification.
    recording
        A file with the same channels as one of the fitted recordings.
    like
        Index of that recording; its mapping, drive and zeros are used.

    Returns
    -------
    dict
        ``rms`` [SI] and ``correlation`` by channel, ``pieces`` with the rms of each, ``units`` by channel,
        ``file``, ``sha256`` and ``directory``.

    Raises
    ------
    SpecError
        If the recording cannot be read through the mapping, or its pieces are too short.
    RefusedError
        If the identification is not finished.
    NotConvergedError
        If the starts could not be fitted.
    """
    info, result = read_info(directory), read_result(directory)
    if not result["recordings"]:
        raise SpecError(f"{recording}: {directory} was fitted to orbits alone; give a table of orbits.")
    tables = info.identity["spec"]["recordings"]
    if not 0 <= like < len(tables):
        raise SpecError(f"like = {like}: there are recordings 0 to {len(tables) - 1}.")
    table = RecordingTable.model_validate(
        {
            "file": str(recording),
            "mapping": "",
            "drive": tables[like]["drive"],
            **{key: tables[like][key] for key in ("parameters", "frequency_hz", "phase") if key in tables[like]},
        }
    )
    if table.drive == "known" and table.phase is None:
        raise SpecError(
            f"like = {like}: the phase of its drive was fitted, and that of {recording} is not known; add {recording} "
            "to [[recordings]] of the specification with some of its pieces in hold_out, and identify again."
        )
    ds = read_recording(recording, parse_mapping(info.mappings[like], f"mapping of recording {like}"))
    model = load_model(result["model"])
    channels = tuple(result["channels"])
    missing = [name for name in channels if name not in ds]
    problems = [f"{recording}: has no channel {name!r}; it must have those that were fitted." for name in missing]
    problems += drive_problems(model, [table], [ds], str(recording))
    if problems:
        raise SpecError(problems)
    pieces = pieces_of(model, channels, (ds, smooth(ds)), table, like)
    pieces = apply_settings(pieces, {like: table.parameters})
    zeros = result["zeros"]
    free = tuple(Free(name, value) for name, value in zeros.items())
    problem = Problem(
        model=model,
        fixed=Parameters(model, result["values"]),
        free=free,
        channels=channels,
        pieces=tuple(pieces),
        noise=np.array([result["noise"][c] for c in channels]),
        rtol=float(info.identity["spec"]["fit"]["rtol"]),
        recorded=table.drive == "recorded",
    )
    judgement, fit = judge(problem, result["values"], zeros, pieces)
    require_starts(fit, f"pieces of {recording}")
    return {
        "directory": str(directory),
        "file": Path(recording).name,
        "sha256": ds.attrs["sha256"],
        "units": {c: model.state(c).unit for c in channels},
        **judgement.as_dict(),
    }
