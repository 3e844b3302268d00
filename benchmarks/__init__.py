"""What is measured of the engine, and how: ``make bench`` or ``python -m benchmarks``."""
