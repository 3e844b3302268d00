"""``rce fleet``: tasks, robots and cells of a fleet on the command line."""
