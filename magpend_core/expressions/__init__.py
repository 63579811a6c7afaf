"""Expressions as graphs: simplify, differentiate and write them as Python source, without the compiler."""
