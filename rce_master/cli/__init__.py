"""Commands that the master plugs into the ``rce`` program."""
