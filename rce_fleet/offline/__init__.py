"""``rce map`` and ``rce localize``: mapping and localization of recorded logs, without a robot."""
