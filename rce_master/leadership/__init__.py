"""Which of several masters leads: by a lease at etcd, for a term."""

from rce_master.leadership.core import Fence, LeadershipCore, LeaseSettings, Role

__all__ = ["Fence", "LeadershipCore", "LeaseSettings", "Role"]
