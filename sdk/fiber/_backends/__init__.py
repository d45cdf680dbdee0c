"""Where agents come from: this process, subprocesses on loopback, later pods."""
