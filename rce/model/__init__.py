"""The vocabulary: names, amounts, and what users ask for. It does no I/O."""
