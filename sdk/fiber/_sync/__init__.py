"""Semaphores in shared memory: the tokens of a process that dies come back."""
