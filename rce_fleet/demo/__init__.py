"""``rce demo``: engine, containers, simulated robots and operator station, all in one terminal."""
