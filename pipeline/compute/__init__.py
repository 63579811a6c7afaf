"""Run tasks: the only room that knows dask, and the pipeline's entry to the kernel."""
