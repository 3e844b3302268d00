"""What asyncio leaves to its users, written once: backoff, owners of tasks, bounded queues."""
