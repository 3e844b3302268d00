"""The master's state as a pure core: commands in, changes out; no I/O, no clock, no task."""
