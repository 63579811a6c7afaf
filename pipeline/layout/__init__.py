"""From a specification to cells, tasks, chunks, names and identity. Pure: nothing is created."""
