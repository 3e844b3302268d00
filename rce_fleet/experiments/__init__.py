"""The paper's experiments, repeated and extended: machines, measurements, statistics."""
