"""RCE: a cloud robotics engine.

``rce`` holds what every task set and client shares; the programs live in
``rce_master``, ``rce_robot``, ``rce_container`` and ``rce_client``.
"""

__version__ = "0.1.0"
