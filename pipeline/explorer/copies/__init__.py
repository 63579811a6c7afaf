"""Export the interactive page of a run as files that a browser shows without a server."""
