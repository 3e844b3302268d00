"""RCE: a cloud robotics engine.

``rce`` holds the code that task sets and clients share; the programs are in
``rce_master``, ``rce_robot``, ``rce_container`` and ``rce_client``.
"""

__version__ = "0.1.0"
