"""Extend cells that are on no known orbit, and describe the sets that they stay on."""
