"""Additions to asyncio: backoff, owners of tasks, bounded queues, closing of servers."""
