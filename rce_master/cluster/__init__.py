"""The machines of an engine with several masters: members of etcd that join, leave, and tell how they are."""
