"""Follow branches of periodic orbits and equilibria along a parameter, and locate their bifurcations.

    starts, left_out = attracting(attractors, parameters, "frequency", (2.0, 3.0))
    branches = explore(starts, Scope(2.0, 3.0))
    ds = dataset_of(branches, "frequency", parameters, left_out)

An orbit of period p is a fixed point of the p-fold stroboscopic map, or of the p-fold return map of a flow seen at
crossings (`magpend_core.orbits` has its derivative); its branch is followed by pseudo-arclength continuation, whether
it is stable or not. `problems` has the equations of orbits and equilibria, `lockstep` evaluates many of them in one
call of the engine, `arclength` traces, `bifurcations` notices and locates, `following` makes one branch, `limits`
names ends at which the period grows without bound, `exploring` all that hang together, `searching` finds orbits of
detached ones, `curves` continues located points in two parameters (`equilibrium_curves`: those of equilibria, with
normal forms by `center_manifold`; `homoclinic_curves`: homoclinic orbits, with the equations of `homoclinic`).
`connecting` says which orbits of a grid of parameter points lie on one branch or sheet, which `sheets` keeps. Any
`magpend_core.engine.system.System` will do;
names, units and the class of a motion are the model's.

Located bifurcations
--------------------
==================== ======================================== =============================================
kind                 test function                            at the point
==================== ======================================== =============================================
``fold``             parameter's share of the unit tangent    the branch turns back; a multiplier is +1
``period_doubling``  det(M + 1)                               a real multiplier is -1
``neimark_sacker``   product of mu_i mu_j - 1, i < j          a complex pair lies on the unit circle
``branch_point``     det of the derivative and the tangent    another branch of the same period crosses
``pitchfork``,       the same                                 the two kinds of branch points
``transcritical``
``hopf``             product of l_i + l_j, i < j              a pair of eigenvalues of an equilibrium is imaginary
==================== ======================================== =============================================

M is the monodromy matrix. A step is halved if the sign changes do not explain its change of the number of
unstable multipliers. A real pair with product 1 (a neutral saddle) is no bifurcation and is dropped. Each
point is bracketed to 1e-8 of arclength. A doubling is *supercritical* if the branch of twice the period lies
where the single orbit has more unstable multipliers, and so says its normal form (`normal_forms`, also for
the other kinds); ``contradictory`` if the two disagree. A branch point is a pitchfork or transcritical if the
quadratic coefficient tells. Two sign changes of the same test function within one step are missed.

Friction's corner
-----------------
The friction torque contains |v|: it is once continuously differentiable at a velocity reversal, its second
derivative jumps. What that means here:

* Trajectories that cross v = 0 with an acceleration make a smooth map all the same, since the instant of
  the crossing is a smooth function of the start. The map loses its second derivative only where an orbit
  touches v = 0, that is, where the number of reversals per period changes. On the branches of period 1 and
  2 of the preset between 2 and 3 Hz it does not: each joint reverses twice per drive period at every point.
  So the theory of smooth maps applies there, criticality included. Where orbits graze (more reversals at
  lower frequencies), test functions stay continuous, but may have a corner; a located point is then right
  and its criticality not to be trusted beyond what the doubled branch shows.
* The integration does feel it. Tangent vectors meet a corner in the Jacobian inside a step. So they are held
  to the tolerance with the states; without that, doublings of period 1 were off by up to 2e-7 Hz. With it the
  six between 2 and 2.6 Hz move by less than 1e-9 Hz as the tolerance goes from 1e-11 to 1e-13, so that the
  bracket of 1e-8 is their accuracy.

The dataset
-----------
Dims ``branch``, ``point`` (in the order along a branch), ``phase`` (section points of an orbit in the order
of time), ``state``, ``multiplier`` (by falling modulus), ``bifurcation``, ``end`` (0: first, 1: last), and the model's
dim of angles. Each variable's ``long_name`` says what it is (`dataset`). Beyond a branch's own points and phases values
are NaN, counts -1. ``side`` is there if the model has words for motions; ``eigenvalue_...`` if there are equilibria;
``limit_...`` if a period grows without bound; ``searched_...`` and ``box_...`` after a search of all orbits or
equilibria. Parameters with other values than the run's own are variables of their name. Attributes ``parameter``,
``parameter_units``, ``model``, ``left_out``: a line for each attractor that was not followed, for each end within the
interval at which a branch was cut off, with what was met there, and for each bound that branches pass.

``first_end`` and ``last_end`` say why a branch ends: ``bound`` of the parameter, ``closed`` on itself, ``start`` (it
sprang off there), ``period_halving`` (on the orbit of half the period), ``max_points``, ``stuck`` (Newton's method
fails for the shortest step, or the last steps led nowhere), ``equilibrium`` (a cycle of a flow that shrinks to a
point, as at a Hopf bifurcation),
``tangent`` (its cycles only touch the section), ``other_section`` (its cycles go on as a branch on the run's section),
``homoclinic`` or ``snic`` (their period grows without bound, see `limits`), ``unstable`` (with --stable: some points
beyond its stable part).
"""
