"""Several ROS masters as one system: discovery, synchronization, relays.

Speaks the wire of fkie's master_discovery and master_sync, so that either side may be theirs.
"""
