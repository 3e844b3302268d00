"""The store of the desired state: a narrow interface, with SQLite by default."""

from rce_master.store.base import Row, Snapshot, Store
from rce_master.store.memory import MemoryStore
from rce_master.store.sqlite import SqliteStore

__all__ = ["MemoryStore", "Row", "Snapshot", "SqliteStore", "Store"]
