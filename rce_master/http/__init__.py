"""The master's HTTP server: the entry point of clients, REST API, events and metrics."""
