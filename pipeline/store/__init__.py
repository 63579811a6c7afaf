"""Keep runs in their directories. No other room knows zarr."""
