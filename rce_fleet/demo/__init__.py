"""``rce demo``: engine, containers, simulated robots and operator station in one terminal."""
