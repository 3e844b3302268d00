"""The store in etcd, for masters on several machines, over etcd's JSON gateway."""

from rce_master.store.etcd.client import EtcdClient
from rce_master.store.etcd.store import EtcdStore

__all__ = ["EtcdClient", "EtcdStore"]
