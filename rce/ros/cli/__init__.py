"""Commands of ``rce`` about ROS graphs: ``core``, ``discovery``, ``relay``, ``run``, ``sync``."""
