"""The operator station: the fleet's web page, and HTTP for an ERP, as a client of the engine."""
