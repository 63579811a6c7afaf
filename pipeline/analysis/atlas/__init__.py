"""Chart a plane of two parameters: regions, curves, and what neither explains."""
