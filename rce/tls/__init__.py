"""TLS for every connection of the engine: certificates, contexts, and servers that answer in TLS."""
