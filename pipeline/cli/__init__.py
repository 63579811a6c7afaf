"""Run the commands of ``magpend``: parse arguments, call the library, print results."""
