"""Recordings of a virtual rig: a sweep in steps, its states through noisy sensors of 12 bits."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from magpend_core.models import load_model
from magpend_core.sections import run_branches
from magpend_core.trajectory import trajectory

RATE_HZ = 1000.0
RIGHT, LEFT = [0.05208, 0.13572, -3.01085, 3.20903], [-0.05224, -0.14464, -2.15267, 2.90480]
"""States on the right motion of period 2 at 2.46 Hz, and on the left one of period 1 at 2.54 Hz."""
SWEPT = (2.46, 2.48, 2.5, 2.52, 2.54)
PERIODS, TRANSIENT = 110, 60

RUN = f"""
kind = "continuation"
title = "walks from 2.44 to 2.56 Hz"
[axes]
frequency_hz = {{ start = 2.44, stop = 2.56, step = 0.01 }}
[continuation]
path = "frequency_hz"
direction = "both"
[initial_conditions]
kind = "list"
points = [{RIGHT}, {LEFT}, [-0.052, -0.145, -2.15, 2.90], [0.022, 0.145, -2.15, 2.90]]
[integration]
rtol = 1e-7
atol = 1e-7
n_transient = 300
n_keep = 40
"""


def walked(parameters, frequencies, start, **options):
    """Result of the engine's walk along frequencies."""
    packed = np.broadcast_to(parameters.pack(), (1, len(frequencies), len(parameters.names)))
    options = {"rtol": 1e-9, "atol": 1e-9, **options}
    places = np.array(frequencies)[None], np.array([start])
    return run_branches(packed, *places, system=parameters.model.system, **options)


def stepped(parameters, steps, start, *, noise=1e-3, bits=12, seed=1, drive_noise=0.02, rate_hz=RATE_HZ):
    """Record a drive of (frequency_hz, n_periods) steps; the state is carried on.

    Returns the recording, and the true states at the rising edges of each step. It integrates with the dense
    output of single trajectories, not with what the virtual rig of the pipeline uses.
    """
    rng = np.random.default_rng(seed)
    model = parameters.model
    state, begin, n_done = np.array(start, np.float64), 0.0, 0
    times, states, drive, truth = [], [], [], []
    for frequency, n_periods in steps:
        end = begin + n_periods / frequency
        n_next = int(np.ceil(end * rate_hz - 1e-9))
        grid = np.arange(n_done, n_next) / rate_hz - begin
        edges = np.arange(n_periods + 1) / frequency
        wanted = np.unique(np.concatenate([np.maximum(grid, 0.0), edges]))
        found = trajectory(parameters, frequency, state, wanted, rtol=1e-7, atol=1e-7)
        times.append(grid + begin)
        states.append(found[np.searchsorted(wanted, np.maximum(grid, 0.0))])
        truth.append(found[np.searchsorted(wanted, edges)])
        drive.append(np.where((grid * frequency) % 1 < parameters["duty_cycle"], 1.0, -1.0))
        state, begin, n_done = found[-1], end, n_next
    time, x, signal = (np.concatenate(part) for part in (times, states, drive))
    angles = [i for i, angle in enumerate(model.is_angle) if angle]
    step = 2 * np.pi / 2**bits
    names = model.state_names
    sensed = {
        names[i]: ("sample", np.round((x[:, i] + rng.normal(0, noise, time.size)) / step) * step if noise else x[:, i])
        for i in angles
    }
    sensed["drive"] = ("sample", signal + rng.normal(0, drive_noise, time.size))
    ds = xr.Dataset(
        sensed,
        coords={"time": ("sample", time), "piece": ("sample", np.zeros(time.size, np.int64))},
        attrs={"model": model.name, "sampling_rate_hz": rate_hz, "file": "virtual rig", "simulated": 1},
    )
    return ds, truth


@pytest.fixture(scope="session")
def pendulum():
    """The rig's true parameters."""
    return load_model("pendulum").load("wojna2018")


@pytest.fixture(scope="session")
def record_steps():
    """`stepped`."""
    return stepped


@pytest.fixture(scope="session")
def swept(pendulum):
    """Recordings of a sweep up on the right motion and down on the left one, and their true sections."""
    up = stepped(pendulum, [(f, PERIODS) for f in SWEPT], RIGHT, seed=1)
    down = stepped(pendulum, [(f, PERIODS) for f in SWEPT[::-1]], LEFT, seed=2)
    return up, down


@pytest.fixture(scope="session")
def run_directory(computed):
    """A run of the rig's model over the swept range."""
    return computed(RUN)
