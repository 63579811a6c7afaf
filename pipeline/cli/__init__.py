"""Define the command line ``magpend``: parse arguments, call the library, print results."""
