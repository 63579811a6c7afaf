"""Export a run as files that a browser shows without a server: one file, or a folder."""
