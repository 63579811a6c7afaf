"""Run the command line: parse, call, print."""
