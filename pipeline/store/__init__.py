"""Store runs in run directories, in folders or object stores. No other package uses zarr."""
