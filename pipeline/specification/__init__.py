"""Read specifications: tables, starts, parsing, and sentences about their problems."""
