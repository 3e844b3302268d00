"""The Master Task Set: users, desired state, placement, reconciliation, HTTP."""
