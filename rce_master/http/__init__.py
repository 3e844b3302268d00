"""The master's HTTP server: the clients' entry, REST API, events and metrics."""
