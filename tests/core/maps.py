"""The section map of a driven system, as tests use it."""

from magpend_core.orbits import section_map


def stroboscopic_map(*given, **options):
    """Images of section points, and the derivatives of the last images."""
    found = section_map(*given, **options)
    return found.images, found.derivatives
