"""What asyncio leaves to its users, written once: pauses between attempts, owners of tasks."""
