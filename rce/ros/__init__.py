"""ROS 1 on the wire, without a ROS installation.

- :mod:`rce.ros.types`: message and service types, their checksums and serialization;
- :mod:`rce.ros.packages`, :mod:`rce.ros.substitution`: folders of nodes and definitions, ``$(find PKG)``;
- :mod:`rce.ros.core`: the Master API and the parameter server;
- :mod:`rce.ros.tcpros`: connections of topics and services;
- :mod:`rce.ros.node`: :class:`~rce.ros.node.Node`, for writing nodes;
- :mod:`rce.ros.actions`, :mod:`rce.ros.tf`: actions and transforms;
- :mod:`rce.ros.multimaster`: discovery, synchronization and relays of several masters;
- :mod:`rce.ros.launch`, :mod:`rce.ros.launching`: launch files, and their nodes as processes;
- :mod:`rce.ros.tools`, :mod:`rce.ros.cli`: programs and ``rce`` commands for ROS graphs.
"""
