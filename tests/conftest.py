"""How hypothesis draws examples: the same ones in every run of the suite, unless one asks for fresh ones.

``HYPOTHESIS_PROFILE=fresh`` draws new examples in every run, more of them, and remembers what failed.
"""

from __future__ import annotations

import os

from hypothesis import settings

# a deadline would fail where the machine is busy, and what is compiled at first use takes long once
settings.register_profile("repeatable", derandomize=True, database=None, deadline=None, print_blob=True)
settings.register_profile("fresh", deadline=None, max_examples=300, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))
