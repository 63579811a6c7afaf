"""What one does with a run: run, status, verify, zoom."""
