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
of time), ``state``, ``multiplier`` (by falling modulus), ``bifurcation``, and the model's dim of angles.
Beyond a branch's own points and phases values are NaN, counts -1. ``side`` is there if the model has words
for motions; parameters with other values than the run's own are variables of their name. Attributes
``parameter``, ``parameter_units``, ``model``, ``left_out``: a line for each attractor that was not followed, and
``stuck``: a line for each end that is stuck, with what was met there.

================================= ======================== ===================================================
variable                          dims                     meaning
================================= ======================== ===================================================
``parameter``                     branch, point            value of the parameter
``section``                       branch, point, phase,    section points, angles wrapped
                                  state
``multiplier_real``, ``_imag``    branch, point,           Floquet multipliers over the orbit's period
                                  multiplier
``n_unstable``                    branch, point            multipliers outside the unit circle
``side``                          branch, point            class of the motion, from the whole orbit
``residual``                      branch, point            scaled distance of the point from its image
``period_s``                      branch, point            period of the orbit [s]
``eigenvalue_real``, ``_imag``    branch, point,           eigenvalues of an equilibrium [1/s]; absent if there
                                  multiplier               are no equilibria
``orbit_period``, ``n_points``    branch                   drive periods or returns, 0 for equilibria; points
``origin``                        branch                   bifurcation that it sprang from, -1 none
``first_end``, ``last_end``       branch                   why it ends: at a bound of the parameter, closed on
                                                           itself, on the orbit of half the period, after too
                                                           many points, stuck (Newton's method fails for the
                                                           shortest step), start (it sprang off there),
                                                           equilibrium (a cycle of a flow that shrinks to a
                                                           point there, as at a Hopf bifurcation), tangent
                                                           (its cycles only touch the section),
                                                           other_section (its cycles go on as a branch on
                                                           the run's section), homoclinic or snic (their period
                                                           grows without bound, see `limits`)
``limit_value``, ``_error``       branch, end              such an end's parameter value; absent if there is none,
                                                           like all that follows
``limit_state``                   branch, end, state       equilibrium at which the cycles come to rest
``limit_eigenvalue_real``,        branch, end,             its eigenvalues [1/s]
``_imag``                         multiplier
``limit_slope``, ``_error``,      branch, end              slope of the law of the period, fitted, its error, and
``_expected``                                              computed from the equilibrium
``frequency``                     branch                   drive frequency, NaN if that is the parameter; a
                                                           flow has none
``rotation``                      branch, angle            mean turns per drive period or return
``kind``, ``value``, ``bracket``  bifurcation              what, where, between parameter values how far apart
``of_branch``, ``after``          bifurcation              its branch, and the point after which it comes
``to_branch``                     bifurcation              the other branch through it, -1 none or unknown
``n_unstable_before``, ``_after`` bifurcation              along the branch
``rises_before``                  bifurcation              whether the parameter rises along the branch before
``criticality``                   bifurcation              unknown, supercritical, subcritical, contradictory
``critical_real``, ``_imag``      bifurcation              the multiplier on the circle
``bifurcation_multiplier_real``,  bifurcation,             all of them
``_imag``                         multiplier
``bifurcation_section``           bifurcation, phase,      the orbit
                                  state
``bifurcation_side``              bifurcation              its side
``bifurcation_period_s``          bifurcation              its period [s]; of a Hopf point that of its cycles
``normal_form``, ``_error``       bifurcation              coefficient of the normal form, NaN if unknown
``searched_value``, ...           searched                 parameter value where all orbits were searched, and
                                                           those of the run's other axes (option ``isolas``)
``coverage``                      searched                 estimated share of starts that lead to an orbit found
``n_orbits``                      searched, times          orbits of this least period, with those on branches
``index_sum``, ``index_verdict``  searched, times          sum of the indices of the fixed points of the map taken
                                                           so many times; what it says (see `searching`)
================================= ======================== ===================================================
"""
