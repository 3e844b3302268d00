"""The fault suite: several masters and their etcd on machines of their own, faults, and a check."""
