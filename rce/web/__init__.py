"""Shared parts of the HTTP servers: route table, OpenAPI, origin check, server."""
