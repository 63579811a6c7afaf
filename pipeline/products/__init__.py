"""What a run computes of its cells, and what analyses find in a cube; kept in ``derived/``."""
