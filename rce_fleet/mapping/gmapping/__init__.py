"""Grid mapping with a Rao-Blackwellized particle filter, with GMapping's parameters."""
