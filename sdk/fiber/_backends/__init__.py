"""Where children run: this process, agents on this machine, pods."""
