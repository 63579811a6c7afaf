"""Parts that the rooms of analysis share: rows and tables of results, selections, measured points, tolerances."""
