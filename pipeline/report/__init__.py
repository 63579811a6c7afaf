"""Report the results of runs and studies as HTML pages, with the paper's figures and claims judged."""
