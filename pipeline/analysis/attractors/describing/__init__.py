"""Label the cells of a parameter point, and compute the features of its attractors."""
