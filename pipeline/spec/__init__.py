"""What a person writes: tables, starts, parsing, and what is wrong with them."""
