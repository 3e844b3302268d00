"""A simulated world: walls, boxes, doors, people, and robots with wheels, sensors and batteries. Pure."""
