"""Turn a run's specification into cells, tasks, chunks, names and an identity, without creating any file."""
