"""The system calls that the processes of a container may make.

Calls that are not listed here do not exist for them (``ENOSYS``), so that programs fall back to older calls;
refused calls fail as without permission (``EPERM``). Names that an architecture does not have are skipped.
"""

from __future__ import annotations

import errno
import socket
from typing import NamedTuple

from rce_container.forkserver.kernel import Namespaces

_LOW_HALF = 0xFFFF_FFFF
_NAMESPACE_TIME = 0x80
_NETLINK_ROUTE = 0


class Match(NamedTuple):
    """A condition: an argument has a value where a mask has ones."""

    argument: int
    mask: int
    value: int


class Rule(NamedTuple):
    """A call that is allowed if all conditions hold."""

    call: str
    matches: tuple[Match, ...]


def _word(argument: int, value: int) -> Match:
    """A 32-bit argument's value; the kernel ignores the upper half of the register too."""
    return Match(argument, _LOW_HALF, value)


_MAKES_NAMESPACES = sum(kind.value for kind in Namespaces) | _NAMESPACE_TIME

_FILES = """
access chdir chmod chown chown32 close close_range copy_file_range creat dup dup2 dup3 execve execveat
faccessat faccessat2 fadvise64 fadvise64_64 fallocate fchdir fchmod fchmodat fchmodat2 fchown fchown32
fchownat fdatasync fgetxattr flistxattr flock fremovexattr fsetxattr fstat fstat64 fstatat64
fstatfs fstatfs64 fsync ftruncate ftruncate64 futimesat getcwd getdents getdents64 getxattr
inotify_add_watch inotify_init inotify_init1 inotify_rm_watch ioctl lchown lchown32 lgetxattr link linkat
listxattr llistxattr _llseek lremovexattr lseek lsetxattr lstat lstat64 mkdir mkdirat mknod
mknodat newfstatat open openat openat2 pipe pipe2 pread64 preadv preadv2 pwrite64 pwritev pwritev2 read
readahead readlink readlinkat readv removexattr rename renameat renameat2 rmdir sendfile sendfile64 setxattr
splice stat stat64 statfs statfs64 statx symlink symlinkat sync_file_range tee truncate
truncate64 umask unlink unlinkat utime utimensat utimensat_time64 utimes vmsplice write writev
"""
_MEMORY = """
brk get_mempolicy madvise mbind membarrier mincore mlock mlock2 mlockall mprotect mremap mseal
msync munlock munlockall munmap pkey_alloc pkey_free pkey_mprotect process_madvise remap_file_pages
set_mempolicy set_mempolicy_home_node
"""
_PROCESSES = """
arch_prctl capget capset exit exit_group fork futex futex_requeue futex_time64 futex_wait futex_waitv
futex_wake get_robust_list get_thread_area getcpu getegid getegid32 geteuid geteuid32 getgid getgid32
getgroups getgroups32 getpgid getpgrp getpid getppid getpriority getrandom getresgid getresgid32 getresuid
getresuid32 getrlimit getrusage getsid gettid getuid getuid32 ioprio_get ioprio_set kill landlock_add_rule
landlock_create_ruleset landlock_restrict_self pidfd_open pidfd_send_signal prctl prlimit64 restart_syscall
riscv_flush_icache rseq rt_sigaction rt_sigpending rt_sigprocmask rt_sigqueueinfo rt_sigreturn rt_sigsuspend
rt_sigtimedwait rt_sigtimedwait_time64 rt_tgsigqueueinfo sched_get_priority_max sched_get_priority_min
sched_getaffinity sched_getattr sched_getparam sched_getscheduler sched_rr_get_interval
sched_rr_get_interval_time64 sched_setaffinity sched_setattr sched_setparam sched_setscheduler sched_yield
seccomp set_robust_list set_thread_area set_tid_address setfsgid setfsgid32 setfsuid setfsuid32 setgid
setgid32 setgroups setgroups32 setpgid setpriority setregid setregid32 setresgid setresgid32 setresuid
setresuid32 setreuid setreuid32 setrlimit setsid setuid setuid32 sigaltstack signalfd signalfd4 sigreturn
sysinfo tgkill time times tkill ugetrlimit uname vfork wait4 waitid waitpid
"""
_WAITING = """
alarm clock_getres clock_getres_time64 clock_gettime clock_gettime64 clock_nanosleep clock_nanosleep_time64
epoll_create epoll_create1 epoll_ctl epoll_ctl_old epoll_pwait epoll_pwait2 epoll_wait epoll_wait_old
eventfd eventfd2 getitimer gettimeofday nanosleep pause poll ppoll ppoll_time64 pselect6 pselect6_time64
select setitimer timer_create timer_delete timer_getoverrun timer_gettime timer_gettime64 timer_settime
timer_settime64 timerfd_create timerfd_gettime timerfd_gettime64 timerfd_settime timerfd_settime64
"""
_TALKING = """
accept accept4 bind connect getpeername getsockname getsockopt listen mq_getsetattr mq_notify mq_open
mq_timedreceive mq_timedreceive_time64 mq_timedsend mq_timedsend_time64 mq_unlink msgctl msgget msgrcv
msgsnd recv recvfrom recvmmsg recvmmsg_time64 recvmsg semctl semget semop semtimedop semtimedop_time64 send
sendmmsg sendmsg sendto setsockopt shmat shmctl shmdt shutdown
"""

ALLOWED = tuple(f"{_FILES} {_MEMORY} {_PROCESSES} {_WAITING} {_TALKING}".split())
"""Calls that are allowed with any arguments."""

_FAMILIES = (socket.AF_UNIX, socket.AF_INET, socket.AF_INET6)
_PERSONALITIES = (0x0, 0x8, 0x2_0000, 0x2_0008, _LOW_HALF)
"""Linux, with 32-bit addresses, with an old version's number, and the question which one it is."""

_HUGE = {"mmap": (3, 0x4_0000), "mmap2": (3, 0x4_0000), "memfd_create": (1, 0x4), "shmget": (2, 0o4000)}
"""The flags that request huge pages: the machine has few of them, and no limit counts them."""
_FILE_COMMANDS_BELOW = 64
_FILE_COMMANDS = range(1025, 1039)
"""Allowed commands of ``fcntl``; without leases (1024), by which an owner blocks others that open a file."""

CONDITIONAL = (
    *(Rule(call, (_word(0, family),)) for call in ("socket", "socketpair") for family in _FAMILIES),
    Rule("socket", (_word(0, socket.AF_NETLINK), _word(2, _NETLINK_ROUTE))),
    Rule("clone", (Match(0, _MAKES_NAMESPACES, 0),)),
    Rule("unshare", (Match(0, _MAKES_NAMESPACES, 0),)),
    *(Rule(call, (Match(argument, flag, 0),)) for call, (argument, flag) in _HUGE.items()),
    *(Rule(call, (Match(1, _LOW_HALF ^ (_FILE_COMMANDS_BELOW - 1), 0),)) for call in ("fcntl", "fcntl64")),
    *(Rule(call, (_word(1, code),)) for call in ("fcntl", "fcntl64") for code in _FILE_COMMANDS),
    *(Rule("personality", (_word(0, personality),)) for personality in _PERSONALITIES),
)
"""Calls that are allowed with some arguments. A netlink socket lists a machine's addresses."""

_REFUSED = """
acct add_key adjtimex bpf chroot clock_adjtime clock_settime delete_module fanotify_init fanotify_mark
finit_module fsconfig fsmount fsopen fspick init_module io_uring_enter io_uring_register io_uring_setup
ioperm iopl kcmp kexec_file_load kexec_load keyctl lookup_dcookie mount mount_setattr move_mount move_pages
migrate_pages name_to_handle_at nfsservctl open_by_handle_at open_tree perf_event_open pidfd_getfd
pivot_root process_mrelease process_vm_readv process_vm_writev ptrace quotactl quotactl_fd reboot
request_key setdomainname sethostname setns settimeofday stime swapoff swapon sysfs syslog umount umount2
uselib userfaultfd vhangup vm86 vm86old
"""

REFUSED = tuple(_REFUSED.split())
"""Calls that exist and are denied."""

PRETENDED = ("sync", "syncfs")
"""Calls that do nothing and succeed: containers have no data on disks, and others share the disks."""

INVISIBLE = errno.ENOSYS
"""The result of unknown calls.

They include ``clone3``, whose flags are in memory that a filter cannot read, and ``io_setup``, of whose
contexts the machine has a fixed number.
"""
DENIED = errno.EPERM
