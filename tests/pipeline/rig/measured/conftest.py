"""Recordings of a virtual rig: a sweep in steps, its states through noisy sensors of 12 bits."""

from __future__ import annotations

import numpy as np
import xarray as xr

from magpend_core.trajectory import trajectory

RATE_HZ = 1000.0


def stepped(parameters, steps, start, *, noise=1e-3, bits=12, seed=1, drive_noise=0.02, rate_hz=RATE_HZ):
    """Record a drive of (frequency_hz, n_periods) steps; the state is carried on.

    Returns the recording, and the true states at the rising edges of each step.
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
        names[i]: (
            "sample",
            np.round((x[:, i] + rng.normal(0, noise, time.size)) / step) * step if noise else x[:, i],
        )
        for i in angles
    }
    sensed["drive"] = ("sample", signal + rng.normal(0, drive_noise, time.size))
    ds = xr.Dataset(
        sensed,
        coords={"time": ("sample", time), "piece": ("sample", np.zeros(time.size, np.int64))},
        attrs={"model": model.name, "sampling_rate_hz": rate_hz, "file": "virtual rig", "simulated": 1},
    )
    return ds, truth
