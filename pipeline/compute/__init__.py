"""Tasks and how they are run: the only room that knows dask, and the kernel's door for pipelines."""
