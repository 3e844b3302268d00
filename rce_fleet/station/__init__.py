"""The operator station: the fleet's page, and HTTP for an ERP; with the engine or without it."""
