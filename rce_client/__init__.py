"""The client side: :class:`rce_client.connection.Connection`, and ``rce-ros``, which bridges a ROS graph."""
