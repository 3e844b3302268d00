"""The Robot Task Set: the WebSocket endpoint of robots, one namespace per robot, converters, forwarders."""
