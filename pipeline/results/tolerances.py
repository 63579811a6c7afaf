"""List the numerical tolerances of all analyses, each with its reason.

Distances are in units of the states' scales. A ``..._RTOL`` is the relative and absolute tolerance of an integration.
The tolerances of Newton's method on orbits are arguments of `magpend_core.orbits.polish_orbits`; those that users can
change are options (`pipeline.products`).
"""

from __future__ import annotations

# ---- integrations ------------------------------------------------------------------------------

BRANCH_RTOL = 1e-12
"""Orbits on branches: residuals go below 1e-10, and differences by a parameter keep six digits."""

CONNECT_RTOL = 1e-8
"""Orbits that are followed from one parameter value to the next only to see which others they meet."""

SEARCH_RTOL, SEARCH_CLOSE = 1e-8, 1e-7
"""Newton's method from many starts on the orbits around a chaotic set, and the residual to which it leads: those found
are polished.
"""

VOLUME_RTOL = 1e-11
"""Volumes along the flow: their change must be known better than `PRESERVED_VOLUME`."""

PORTRAIT_RTOL = 1e-9
"""Motions on attractors, for ranges and portraits: errors stay far below those of the sampling."""

CROSSING_RTOL = 1e-9
"""Crossings of a limit cycle: they are compared within `SAME_RETURN`."""

PASSAGE_RTOL = 1e-9
"""Trajectories that pass the place of an orbit that is gone: the lengths of their stays are statistics."""

NEAR_RTOL = 1e-8
"""First polish of guesses, which ends at `NEAR_RESIDUAL`."""

SLOPE_RTOL = 1e-8
"""Derivatives along extended cells: sufficient for exponents."""

ROUGH_SLOPE_RTOL = 1e-6
"""The same where chaos is plain: sampling leaves a larger error in the exponents."""

WAIT_RTOL = 1e-10
"""Cells that wait for a return: around a slow focus, 1e-8 keeps them 3e-6 away, and they never come to rest."""

EXTEND_RTOL = 1e-8
"""Guesses that are integrated until they close: Newton's method follows."""

# ---- closed cells and orbits -------------------------------------------------------------------

CELL_CLOSURE = 1e-5
"""Extended cells count as closed within this distance."""

EXTEND_CLOSURE = 1e-5
"""Guesses count as closed within this distance; Newton's method converges from there."""

STRICT = 1e-3
"""Largest tolerance at which a closed cell shows an orbit without Newton's method."""

LOOSE_SHARE = 0.1
"""Share of a tolerance above `STRICT` within which a closed cell counts as on an orbit."""

REACH = 0.3
"""Distance from an orbit within which cells are tested for spiralling in."""

NEAR_RESIDUAL, NEARLY_RESIDUAL = 1e-7, 1e-3
"""Residual that the first polish is to reach, and the largest with which an orbit is polished further.

Many guesses lead to the same orbit, and only one of them is polished further. Very unstable orbits miss the first
residual at a loose tolerance.
"""

SAME_HALF = 1e-6
"""Largest distance of an orbit's section points after a part of its period at which the part is the period."""

SAME_LEVEL = 1e-6
"""Largest relative difference of two values of a parameter that count as one, as for values on an axis."""

SAME_ORBIT = 1e-7
"""Largest distance between two polished orbits that are one, on top of the errors from their residuals."""

SAME_ON_BRANCH = 1e-6
"""Distance within which two orbits at one value of a branch's parameter are the same."""

SAME_CONNECTED = 1e-5
"""The same for branches that are followed at `CONNECT_RTOL`: the error of an orbit rises towards a fold."""

SAME_RETURN = 1e-2
"""Distance within which a return is tried as the period of a limit cycle."""

SAME_SECONDS = 1e-6
"""Largest relative difference between the periods of a limit cycle that is found twice."""

SAME_POINT = 1e-6
"""Distance below which section points of a set count as one."""

RECURRENCE = 0.1
"""Largest distance of a recurrence in chaos from which Newton's method starts."""

# ---- equilibria --------------------------------------------------------------------------------

NEAR_REST = 0.1
"""Newton's method starts from every cell without a return whose first step is at most twice this."""

AT_EQUILIBRIUM = 1e-9
"""Distance from an equilibrium, stable or not, within which a cell is at it."""

SAME_EQUILIBRIUM = 1e-6
"""Equilibria at most this far apart are one; an orbit at most this far from one is that equilibrium."""

# ---- errors ------------------------------------------------------------------------------------

MATRIX_ERROR = 1e-9
"""Relative error of a monodromy matrix: two methods at tolerance 1e-12 agree to 1e-10."""

RATE_ERROR = 1e-9
"""Relative error of a Jacobian's entries at a polished equilibrium."""

RATE_ROUNDING = 1e-15
"""Relative error of a rate by rounding, near an equilibrium."""

PLACE_ERROR = 30.0
"""Error of a multiplier near a fold per root of the residual: twice the root of the map's curvature."""

NO_INFLUENCE = 1e-9
"""Elasticity of a bifurcation below which a parameter is said to have no influence on it."""

PRESERVED_VOLUME = 1e-7
"""Largest log change of a volume over a period that counts as 0."""
