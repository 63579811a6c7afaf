"""Write HTML pages about runs and about studies (reproductions of a paper), with figures and judged claims."""
