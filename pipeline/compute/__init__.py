"""Compute the tasks of a run. Only this package uses dask, and through it the pipeline calls the compiled core."""
