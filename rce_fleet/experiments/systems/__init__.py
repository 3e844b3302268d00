"""The systems that are compared: adapters that connect the machines of a bench."""
