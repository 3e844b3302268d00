"""Relays pass messages on without decoding them: to another name, another master, or over one connection."""
