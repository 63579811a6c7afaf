"""Models in the files of other programs, read as text and never executed, and written as specifications."""
