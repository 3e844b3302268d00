"""``rce-ros``: joins a robot's ROS graph to the engine, without looking into the messages."""
