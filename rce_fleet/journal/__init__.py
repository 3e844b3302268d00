"""The journal of the fleet manager: what was accepted and what happened, in SQLite."""
