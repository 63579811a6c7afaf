"""Name the events of attractors along a parameter: where they begin, change and end, and by which bifurcation.

An attractor that is a closed orbit or an equilibrium lives where its branch is stable. From the last parameter value
at which cells end on it, its branch is followed until it loses stability (`lines`). So the event is the first
located bifurcation on the branch of that very orbit, wherever it lies on the grid of parameter values; where the
branch gives no reason, the event is not decided. `analysis` joins attractors and branches, and asks the detectors that
`kinds` lists: `cascades`, `passages`, `breakups` and `crises` decide ends of chaotic sets and tori, `crises` by what
`contact`, `connections` and `transients` measure; `grazing` decides those of orbits that touch a surface. `one_event`
finds the ends that are one event; `dataset` has the Dataset, `sentences` the table. `windows` does the same at a few
neighbouring values, with branches near them alone.

Ids that lie on one stable piece of a branch are one attractor and have the least of their ids, since ids of
equilibria rest on distance alone. Nothing is looked for between neighbouring values at which cells end on the same
orbit.

Schema
------
Dims ``event`` (an end of an attractor), ``outcome``, ``doubling``, ``stretch`` (neighbouring parameter values at which
an attractor has one kind and period) and ``end``: the first and the last value of a stretch. Stretches are the nodes of
a graph, whose edges are the events: ``stretch_of`` leads to each ``to_stretch``. Ends at one bifurcation are one event,
see ``same_as``.

`pipeline.analysis.events.declaration` lists the variables.
"""
