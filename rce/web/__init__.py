"""What the engine's HTTP servers share."""
