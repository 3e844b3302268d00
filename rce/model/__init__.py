"""The vocabulary: names, amounts, specs and requests of users. It does no I/O."""
