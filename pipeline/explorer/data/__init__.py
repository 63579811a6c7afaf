"""Read a run for the page: diagrams, planes, orbits, overlays, tables."""
