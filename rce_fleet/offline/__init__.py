"""``rce map``, ``rce localize``, ``rce plan``: from logs, maps and scenarios to files, without robots."""
