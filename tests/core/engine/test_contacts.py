"""Infinitely many impacts in a finite time, and motion at rest on the surface afterwards."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from magpend_core import sections, trajectory
from magpend_core.models import ModelError
from magpend_core.models.text import read_model
from magpend_core.orbits import section_map
from magpend_core.status import Status
from tests.core.flows import table

FREQUENCY = 10.0
OMEGA = 2.0 * math.pi * FREQUENCY
EARTH = 9.81

REBOUND = {"value": 0.5, "bound": "non-negative"}


def sticks(of, **values):
    """An impact where an expression falls to 0, and rest there."""
    return [{"of": of, "direction": "down", "set": values, "stick": True}]


BALL = table(
    "ball-on-table",
    {"h": "v", "v": "-g"},
    {"g": EARTH, "r": REBOUND, "G": 2.0},
    define={"w": "2*pi*f", "amp": "G*g/w**2", "table": "amp*sin(w*t)", "vtable": "amp*w*cos(w*t)"},
    impacts=sticks("h - table", v="vtable - r*(v - vtable)"),
)

# x lies on y, which a spring carries; both masses push one another
LOAD = table(
    "load-on-a-spring",
    {"x": "vx", "vx": "-g", "y": "vy", "vy": "-g - k*y/M"},
    {"m": 1.0, "M": 2.0, "k": 50.0, "g": EARTH, "r": REBOUND},
    define={"mean": "(m*vx + M*vy)/(m + M)", "gap": "vx - vy"},
    impacts=sticks("x - y", vx="mean - r*gap*M/(m + M)", vy="mean + r*gap*m/(m + M)"),
)


@pytest.fixture(scope="module")
def ball():
    return read_model(BALL)


class ExactBall:
    """Ball on a table by closed forms alone: parabolas, their meetings with the table by bisection.

    A series of flights is given up once one takes less than 1e-11 of a period. At rest, the ball leaves where
    the table falls faster than it would.
    """

    def __init__(self, ratio, restitution):
        self.amplitude, self.restitution = ratio * EARTH / OMEGA**2, restitution
        self.ratio = ratio

    def table(self, t):
        return self.amplitude * math.sin(OMEGA * t), self.amplitude * OMEGA * math.cos(OMEGA * t)

    def meets(self, t, h, v):
        """Return the time of flight until the ball meets the table from above."""

        def gap(s):
            return h + s * (v - 0.5 * EARTH * s) - self.table(t + s)[0]

        step = 1e-4 / FREQUENCY
        relative = v - self.table(t)[1]
        bent = -EARTH + self.amplitude * OMEGA**2 * math.sin(OMEGA * t)
        # a flight that begins on the table: begin the search at its middle, if it is short
        low = -relative / bent if bent < 0.0 < relative and relative / -bent < step else step
        if gap(low) <= 0.0:
            return brentq(gap, low * 0.5, low, xtol=1e-18) if gap(low * 0.5) > 0.0 else low
        high = low
        while gap(high) > 0.0:
            low, high = high, high + min(step, high)
        return brentq(gap, low, high, xtol=1e-18, rtol=1e-15)

    def run(self, h, v, n_periods):
        """Return states at the ends of periods."""
        t, rests, found = 0.0, False, []
        ends = [k / FREQUENCY for k in range(1, n_periods + 1)]
        while ends:
            if rests:
                t = self.leaves(t)
                while ends and ends[0] <= t:
                    found.append(self.table(ends.pop(0)))
                h, v = self.table(t)
                rests = False
            flight = self.meets(t, h, v)
            while ends and ends[0] <= t + flight:
                s = ends.pop(0) - t
                found.append((h + s * (v - 0.5 * EARTH * s), v - EARTH * s))
            arriving = v - EARTH * flight
            t += flight
            h, speed = self.table(t)
            v = speed - self.restitution * (arriving - speed)
            pushed = self.ratio * math.sin(OMEGA * t) < 1.0
            rests = pushed and flight < 1e-11 / FREQUENCY
        return np.array(found[:n_periods])

    def leaves(self, t):
        """Return when a ball at rest leaves: the table then falls as fast as it would."""
        if self.ratio <= 1.0:
            return math.inf
        phase = math.asin(1.0 / self.ratio) / OMEGA
        while phase < t:
            phase += 1.0 / FREQUENCY
        return phase


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1.15, 1.7, 1.9, 2.15])
@pytest.mark.parametrize("start", [(0.004, 0.1), (0.0012, -0.3)])
def test_stick__is_that_of_closed_forms(ball, ratio, start):
    exact = ExactBall(ratio, 0.5).run(*start, 12)
    found = sections(
        ball.load("default", G=ratio), FREQUENCY, np.array([start]), n_transient=0, n_keep=12, rtol=1e-12, atol=1e-14
    )
    assert found.section[0] == pytest.approx(exact, rel=0, abs=1e-9)


@pytest.mark.slow
def test_chatter__is_named_where_nothing_sticks(ball):
    loose = {**BALL, "name": "ball-loose", "impacts": [{k: v for k, v in BALL["impacts"][0].items() if k != "stick"}]}
    found = sections(read_model(loose).load("default"), FREQUENCY, np.array([[0.004, 0.1]]), n_transient=0, n_keep=8)
    assert found.status.tolist() == [Status.CHATTER]
    assert np.isnan(found.section).all()
    assert "stick = true" in Status.CHATTER.sentence
    found = sections(ball.load("default", r=1.0, G=0.01), FREQUENCY, np.array([[1e-6, 0.0]]), n_transient=0, n_keep=3)
    assert found.status[0] != Status.CHATTER


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2])
def test_ball__one_impact_in_n_periods_begins_and_doubles_where_published(ball, n):
    """Luck and Mehta, Phys. Rev. E 48, 3988 (1993): the fold at n pi (1 - r)/(1 + r), and the doubling."""
    r = 0.5
    fold = n * math.pi * (1.0 - r) / (1.0 + r)
    doubles = math.sqrt(fold**2 + 4.0 * (1.0 + r * r) ** 2 / (1.0 + r) ** 4)
    for ratio, period in ((1.002 * fold, n), (0.998 * doubles, n), (1.005 * doubles, 2 * n)):
        amplitude, speed = ratio * EARTH / OMEGA**2, 0.5 * EARTH * n / FREQUENCY
        # it flies for n periods and meets the table at this phase, where the table's speed makes up the loss
        t = math.acos(fold / ratio) / OMEGA
        table = amplitude * OMEGA * math.cos(OMEGA * t)
        assert speed - table == pytest.approx(r * (speed + table))
        h = amplitude * math.sin(OMEGA * t) - speed * t - 0.5 * EARTH * t * t
        options = {"n_transient": 6000, "n_keep": 64, "rtol": 1e-10, "atol": 1e-12}
        found = sections(ball.load("default", G=ratio), FREQUENCY, [[h + 1e-7, speed + EARTH * t]], **options)
        assert found.orbit_period.tolist() == [period]


@pytest.mark.slow
def test_load__that_lies_swings_with_its_carrier_and_leaves_where_it_weighs_nothing():
    """At rest on one another both masses are one on the spring, while the load pushes: y'' > -g."""
    model = read_model(LOAD)
    p = model.load("default", r=0.0)
    m, big, k = 1.0, 2.0, 50.0
    drop, period = 3.0, 0.8
    # the carrier waits where the spring holds it alone; the load falls on it, and momentum is kept
    y0 = -EARTH * big / k
    start = np.array([y0 + drop, 0.0, y0, 0.0])
    fall = math.sqrt(2.0 * drop / EARTH)
    together = m * EARTH * fall / (m + big)
    omega, middle = math.sqrt(k / (m + big)), -EARTH * (m + big) / k

    def compound(s):
        a, b = y0 - middle, -together / omega
        y = middle + a * math.cos(omega * s) + b * math.sin(omega * s)
        return y, omega * (-a * math.sin(omega * s) + b * math.cos(omega * s))

    leaves = brentq(lambda s: -(omega**2) * (compound(s)[0] - middle) + EARTH, 0.8, 1.22)
    found = trajectory(
        p, 1.0 / period, start, np.array([fall + 0.9 * leaves, fall + leaves + 0.05]), rtol=1e-12, atol=1e-14
    )
    y, v = compound(0.9 * leaves)
    assert found[0] == pytest.approx([y, v, y, v], abs=1e-9)
    y, v = compound(leaves)
    s, own, rest = 0.05, math.sqrt(k / big), -EARTH * big / k
    flown = [y + v * s - 0.5 * EARTH * s * s, v - EARTH * s]
    swung = rest + (y - rest) * math.cos(own * s) + v / own * math.sin(own * s)
    assert found[1, :3] == pytest.approx([*flown, swung], abs=1e-9)


@pytest.mark.slow
def test_derivatives__of_a_chattering_load_are_those_of_differences():
    """Through impacts without end, rest, and the end of rest."""
    model = read_model(LOAD)
    p = model.load("default")
    start = np.array([[0.1, 0.0, -0.5, 0.3]])
    packed, f = p.pack()[None], np.array([0.4])
    slopes = section_map(packed, f, start, 1, rtol=1e-12, system=model.system).derivatives[0]
    around = np.concatenate([start + 1e-6 * np.eye(4), start - 1e-6 * np.eye(4)])
    given = np.repeat(packed, 8, axis=0), np.repeat(f, 8), around
    ends = section_map(*given, 1, rtol=1e-12, system=model.system).images[:, -1]
    assert slopes == pytest.approx((ends[:4] - ends[4:]).T / 2e-6, abs=2e-4)


def test_rest__goes_on_from_a_section_as_if_it_had_not_stopped(ball):
    p = ball.load("default", G=0.7)
    whole = sections(p, FREQUENCY, np.array([[0.001, 0.0]]), n_transient=0, n_keep=8, rtol=1e-10, atol=1e-12)
    assert whole.orbit_period.tolist() in ([0], [1])
    again = sections(p, FREQUENCY, whole.section[:, 3], n_transient=0, n_keep=4, rtol=1e-10, atol=1e-12)
    assert again.section[0] == pytest.approx(whole.section[0, 4:], abs=1e-15)
    # it lies on the table, at its speed
    assert whole.section[0, -1] == pytest.approx([0.0, 0.7 * EARTH / OMEGA], abs=1e-15)


@pytest.mark.slow
def test_force_that_jumps__lifts_at_its_edge():
    """A force that is on for half a period lifts a ball at rest at once; it flies on parabolas."""
    rates = {"h": "v", "v": "-g + where(square(t*f - 0.25, 0.5) > 0, F, 0)"}
    model = read_model(table("lifted", rates, {"g": 10.0, "F": 30.0}, impacts=sticks("h", v="-0.1*v")))
    found = trajectory(model.load("default"), 0.25, np.array([0.0, 0.0]), np.array([0.9, 1.5, 3.0, 3.5]), rtol=1e-10)
    assert found[:3] == pytest.approx(np.array([[0.0, 0.0], [0.5 * 20 * 0.25, 20 * 0.5], [40.0, 40.0]]), abs=1e-9)
    assert found[3] == pytest.approx([40.0 + 40.0 * 0.5 - 5.0 * 0.25, 35.0], abs=1e-9)


@pytest.mark.parametrize(
    ("impact", "message"),
    [
        ({"of": "h", "set": {"h": "0"}}, "impacts[0].stick"),
        ({"of": "v", "set": {"v": "-v"}}, "impacts[0].stick"),
        ({"of": "h", "set": {"v": "-v"}, "stick": "yes"}, "must be true or false"),
    ],
)
def test_stick__refused(impact, message):
    impacts = [{"direction": "down", "stick": True, **impact}]
    with pytest.raises(ModelError, match=message.replace("[", r"\[")):
        _ = read_model(table("refused", {"h": "v", "v": "-g"}, {"g": 9.81}, impacts=impacts)).system
