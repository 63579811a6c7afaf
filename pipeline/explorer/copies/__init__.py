"""Export a run's interactive page as files that a browser shows without a server: one file, or a folder."""
