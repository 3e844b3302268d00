"""Which cells of a fleet's grid an obstacle fills that is on no map. Pure."""
