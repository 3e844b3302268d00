"""The benchmarks of the engine: ``make bench`` or ``python -m benchmarks``."""
