"""What the results of all analyses are made of: rows, tables, selections, labels, measured points, tolerances."""
