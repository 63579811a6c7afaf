"""Report runs and studies (reproductions of a paper) as HTML pages, with figures and judged claims."""
