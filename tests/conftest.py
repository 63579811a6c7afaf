"""Profiles of property tests: fixed seeds by default, so that the suite says the same twice.

``HYPOTHESIS_PROFILE=search`` draws fresh examples, more of them, and remembers what failed.
"""

import os

from hypothesis import settings

settings.register_profile("ci", derandomize=True, deadline=None, database=None, print_blob=True)
settings.register_profile("search", max_examples=500, deadline=None, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))
