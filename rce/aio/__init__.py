"""Additions to asyncio: backoff, owners of tasks, bounded queues."""
