"""The engine's programs as services of systemd."""
