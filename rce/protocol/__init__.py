"""The protocol between a client and its robot endpoint: vocabulary, messages, binary assembler (sans-I/O)."""
