"""The planner's and the move client's cores: cells granted to one robot each, zones, modes. Pure."""
