"""The models of the fleet's HTTP API below ``/api/v1``."""
