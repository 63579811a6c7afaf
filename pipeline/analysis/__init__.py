"""Analyse the result cubes of runs: functions that take an xarray Dataset and return labelled data.

Most functions only read the cube. Those that find or follow orbits integrate: `attractors.identify`,
`attractors.match` with `connect`, `attractors.portraits`, and the functions of `branches` and `manifolds`.
"""
