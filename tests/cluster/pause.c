/* The process that holds a pod's namespaces: it waits for a signal, and reaps who is left to it. */
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

static void reap(int signal)
{
    while (waitpid(-1, NULL, WNOHANG) > 0) {
    }
}

static void leave(int signal)
{
    _exit(0);
}

int main(void)
{
    signal(SIGCHLD, reap);
    signal(SIGTERM, leave);
    signal(SIGINT, leave);
    for (;;)
        pause();
}
