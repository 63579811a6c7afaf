"""The run directory: the only room that knows zarr."""
