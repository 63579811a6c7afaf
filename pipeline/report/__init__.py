"""Reports: what a study found as one HTML page, and the paper's figures computed and judged."""
