"""One cascade of period doublings for all tests of branches."""

import numpy as np
import pytest

from magpend_core.models import load_model
from pipeline.analysis.branches import analysis
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


def contradictions(ds, rows):
    """Return the rows of located bifurcations whose counts differ from those at the branch's points on both sides."""
    located = [row for row in rows if row["type"] not in ("homoclinic", "snic")]
    wrong = []
    for row, k in zip(located, np.argsort(ds["value"].values, kind="stable"), strict=True):
        branch, after = int(ds["of_branch"][k]), int(ds["after"][k])
        if ((ds["of_branch"] == branch) & (ds["after"] == after)).sum() > 1:
            continue  # between two in one step there is no point
        points = [
            (float(ds["parameter"][branch, i]), str(int(ds["n_unstable"][branch, i]))) for i in (after, after + 1)
        ]
        value, told = float(ds["value"][k]), [row["unstable_below"], row["unstable_above"]]
        if "none" in told:
            (both,) = set(told) - {"none"}
            good = sorted(both.split("|")) == sorted(n for _, n in points)
        else:
            below, above = sorted(points)
            good = below[0] <= value <= above[0] and told == [below[1], above[1]]
        if not good:
            wrong.append((row, points))
    return wrong


@pytest.fixture(autouse=True, scope="session")
def _rows_agree_with_their_branches():
    """Check every table of bifurcations that a test of this folder prints."""
    plain = analysis.table_of

    def checked(ds, **options):
        assert not contradictions(ds, plain(ds))
        return plain(ds, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(analysis, "table_of", checked)
        yield
