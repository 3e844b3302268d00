"""The door of the client protocol: WebSockets with JSON and binary frames (:mod:`rce.protocol`)."""
