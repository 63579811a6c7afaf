"""Compute one-dimensional stable and unstable manifolds of saddle orbits, and locate where they first touch.

Reading order: `growing` has the curves, `tangency` the first homoclinic tangency along a parameter, `product`
the analysis of a run.
"""

from pipeline.analysis.manifolds.growing import Manifold, Saddle, stable_manifold, unstable_manifold
from pipeline.analysis.manifolds.tangency import first_tangency

__all__ = ["Manifold", "Saddle", "first_tangency", "stable_manifold", "unstable_manifold"]
