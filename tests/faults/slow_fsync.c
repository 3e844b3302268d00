/*
 * slow_fsync FILE MILLISECONDS PROGRAM ARGUMENTS...: runs a program whose fsync and fdatasync wait first, while FILE
 * exists. Go's programs call the kernel without libc, so a preloaded library would not see these calls; a
 * seccomp filter does, and a child of this program answers it.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/filter.h>
#include <linux/seccomp.h>
#include <signal.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/ioctl.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <unistd.h>

static void supervise(int listener, const char *file, useconds_t delay)
{
    struct seccomp_notif wanted;
    struct seccomp_notif_resp answer;

    for (;;) {
        wanted = (struct seccomp_notif){0};
        if (ioctl(listener, SECCOMP_IOCTL_NOTIF_RECV, &wanted) != 0) {
            if (errno == EINTR || errno == ENOENT)
                continue;
            _exit(1);
        }
        if (access(file, F_OK) == 0)
            usleep(delay);
        answer = (struct seccomp_notif_resp){.id = wanted.id, .flags = SECCOMP_USER_NOTIF_FLAG_CONTINUE};
        ioctl(listener, SECCOMP_IOCTL_NOTIF_SEND, &answer);
    }
}

int main(int count, char **words)
{
    struct sock_filter steps[] = {
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, offsetof(struct seccomp_data, nr)),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_fsync, 1, 0),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, SYS_fdatasync, 0, 1),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_USER_NOTIF),
        BPF_STMT(BPF_RET | BPF_K, SECCOMP_RET_ALLOW),
    };
    struct sock_fprog filter = {sizeof steps / sizeof *steps, steps};
    int listener;

    if (count < 4) {
        fprintf(stderr, "usage: slow_fsync FILE MILLISECONDS PROGRAM...\n");
        return 2;
    }
    prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0);
    listener = syscall(SYS_seccomp, SECCOMP_SET_MODE_FILTER, SECCOMP_FILTER_FLAG_NEW_LISTENER, &filter);
    if (listener < 0) {
        perror("slow_fsync: seccomp");
        return 1;
    }
    if (fork() == 0) {
        prctl(PR_SET_PDEATHSIG, SIGKILL);
        supervise(listener, words[1], 1000 * atoi(words[2]));
    }
    close(listener);
    execvp(words[3], words + 3);
    perror("slow_fsync: exec");
    return 1;
}
