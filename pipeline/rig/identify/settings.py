"""Apply parameter values that hold for a single recording, such as a drive amplitude of 0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from magpend_core.models.model import Model
from magpend_core.models.parameters import near_names
from magpend_core.sampling import Drive
from pipeline.rig.identify.problem import Piece


def setting_problems(model: Model, values: Mapping[str, float], where: str) -> list[str]:
    """Return problems with values set for one recording: unknown parameters, values out of bounds."""
    found = []
    for name, value in values.items():
        if name not in model.parameter_names:
            hint = near_names(name, model.parameter_names, "parameters")
            found.append(f"{where}.{name}: is not a parameter of {model.name}; {hint}")
            continue
        problem = model.parameter(name).problem(value)
        if problem:
            found.append(f"{where}.{problem}")
    return found


def apply_settings(pieces: Sequence[Piece], settings: Mapping[int, Mapping[str, float]]) -> list[Piece]:
    """Attach parameter values that hold for a single recording to the drives of that recording's pieces.

    Parameters
    ----------
    pieces
        Pieces of any recordings.
    settings
        Values of parameters by index of the recording.

    Returns
    -------
    list of Piece
        The drives of all pieces have values of the same parameters; NaN leaves a parameter unchanged.
    """
    names: dict[str, None] = {}
    for piece in pieces:
        names |= dict.fromkeys(piece.drive.names if piece.drive is not None else ())
        names |= dict.fromkeys(settings.get(piece.recording, {}))
    if not names:
        return list(pieces)
    return [_with(piece, tuple(names), settings.get(piece.recording, {})) for piece in pieces]


def _with(piece: Piece, names: tuple[str, ...], own: Mapping[str, float]) -> Piece:
    drive = piece.drive
    if drive is None:
        time = piece.time
        drive = Drive(np.array([2 * time[-1] - time[-2]]))
    values = np.full((len(drive.durations_s), len(names)), np.nan)
    for k, name in enumerate(names):
        if name in own:
            values[:, k] = own[name]
        elif name in drive.names:
            values[:, k] = drive.values[:, drive.names.index(name)]
    return replace(piece, drive=replace(drive, names=names, values=values))
