"""Tasks of the fleet: their states, the book of tasks, assignment, energy, chargers, parking. Pure."""
