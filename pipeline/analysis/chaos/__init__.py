"""Regular or chaotic: exponents, dimensions, the 0-1 test."""
