"""How well robots navigate: seeded runs among boxes and walkers."""
