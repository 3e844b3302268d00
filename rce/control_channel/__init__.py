"""The channel between the master and its task sets, and what goes beside it on the control port.

:mod:`rce.control` has what is said on it.
"""
