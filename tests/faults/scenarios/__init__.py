"""What is done to the masters and to etcd."""
