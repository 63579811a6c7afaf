"""Run tasks: the only package that uses dask, and the pipeline's entry to the kernel."""
