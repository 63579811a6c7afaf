"""Break-up of tori into chaotic sets: a border collision in closed form, and windows of locking between the two."""

from __future__ import annotations

import re

import numpy as np
import pytest

import magpend

# a rotation by the golden angle beside a map that collides with its corner at mu = 0: for mu < 0 the fixed point
# 2 mu attracts, for mu > 0 neither the fixed point (slope -2.4) nor the orbit of period 2 (-1.2) does, and chaos
# scales with mu (Banerjee, Yorke and Grebogi, Phys. Rev. Lett. 80, 1998, 3049)
ANGLE = f"{np.pi * (3.0 - np.sqrt(5.0)):.15f}"
BORDER = magpend.model(
    f"x' = G*(x*cos({ANGLE}) - y*sin({ANGLE}))\ny' = G*(x*sin({ANGLE}) + y*cos({ANGLE}))\n"
    "z' = mu + where(z < 0, 0.5*z, -2.4*z)\nG = (x**2 + y**2)**(-0.25)",
    name="border", kind="map", mu=0.1,
)  # fmt: skip
DELAYED = magpend.model("x' = a*x*(1 - y)\ny' = x", name="delayed", kind="map", a=2.1)


def sweep(model, folder, starts, **axis):
    spec = magpend.Spec("sweep", model)
    for name, values in axis.items():
        spec = spec.with_axis(name, values=values)
    spec = spec.with_start_random(n=4, seed=0, **starts).with_integration(n_transient=2000, n_keep=400)
    return magpend.run(spec, folder / "run", workers=0)


@pytest.mark.slow
@pytest.mark.usefixtures("long_steps")
def test_events__break_up_at_a_border_collision(tmp_path):
    starts = {"x": (0.5, 1.5), "y": (-1.0, 1.0), "z": (-0.1, 0.1)}
    table = sweep(BORDER, tmp_path, starts, mu=[-0.05, 0.08]).table("events")
    rows = table[table["what"] != "range_end"]
    assert set(rows["what"]) == {"torus_breakup"}
    assert (rows["mu"].abs() <= rows["mu_error"]).all()
    assert (rows["mu_error"] < 1e-4).all()
    assert len(rows) == 1  # the end of the torus and the beginning of chaos are one event


def largest_exponents(a, n=6000, skip=4000):
    """Largest exponents of the delayed logistic map at some values, by iterating the map and a tangent."""
    x, y, v, w, total = 0.51 + 0.0 * a, 0.51 + 0.0 * a, 1.0 + 0.0 * a, 0.0 * a, 0.0 * a
    for k in range(skip + n):
        x, y, v, w = a * x * (1.0 - y), x, a * (1.0 - y) * v - a * x * w, v
        size = np.hypot(v, w)
        v, w, total = v / size, w / size, total + (k >= skip) * np.log(size)
    return total / n


@pytest.mark.slow
@pytest.mark.usefixtures("long_steps")
def test_events__locking_between_a_torus_and_chaos(tmp_path):
    """The torus of the delayed logistic map is locked before it is chaotic (Aronson, Chory, Hall and McGehee, Commun.
    Math. Phys. 83, 1982, 303), for the first time as 1/7.
    """
    starts = {"x": (0.3, 0.6), "y": (0.3, 0.6)}
    table = sweep(DELAYED, tmp_path, starts, a=[2.15, 2.17, 2.262, 2.266]).table("events")
    rows = table[table["what"] != "range_end"]
    assert rows["what"].tolist() == ["not_decided"] * 2
    for text in rows["evidence"]:
        assert "whether the torus breaks up is open" in text
        parts = dict(re.findall(r"(locked|chaotic) at a = ([\d., ]+)(?:;|$)", text))
        told = {word: np.array(part.split(", "), float) for word, part in parts.items()}
        assert len(told["locked"]) > 5
        assert (largest_exponents(told["locked"]) < -2e-3).all()
        assert (largest_exponents(told["chaotic"]) > 5e-3).all()
