"""One cascade of period doublings for all tests of branches."""

import numpy as np
import pytest

from magpend_core.models import load_model
from pipeline.analysis.branches.exploring import Scope, explore
from pipeline.analysis.branches.known import Start
from pipeline.analysis.branches.problems import Family

from .cubes import integrated


@pytest.fixture(scope="session")
def settled():
    """Section point of a Duffing oscillator after some periods."""

    def call(parameters, frequency, state, n=300):
        return integrated(parameters, frequency, [state], n_transient=n, n_keep=1).section[0, 0, -1]

    return call


@pytest.fixture(scope="session")
def cascade(settled):
    """The orbit in one of two wells, which doubles its period at 0.2656 and again at 0.2867: family and branches."""
    parameters, frequency = load_model("duffing").load("twin-well", damping=0.3, amplitude=0.2), 1.2 / (2.0 * np.pi)
    orbits = Family(parameters.model.system, 1, frequency, parameters.pack(), ("amplitude",), (0.1,))
    start = Start(orbits, settled(parameters, frequency, [1.2, 0.0]), 0.2)
    return orbits, explore([start], Scope(0.15, 0.3, max_period=4))
