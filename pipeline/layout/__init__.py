"""Turn a specification into cells, tasks, chunks, names and an identity. Pure: nothing is created."""
