"""Client config files, engine settings, the shared secret, and the places of shipped files."""
