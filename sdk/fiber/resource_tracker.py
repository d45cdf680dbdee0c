"""multiprocessing's tracker of named shared memory, which Fiber does not use."""

from multiprocessing.resource_tracker import ensure_running, register, unregister

__all__ = ["ensure_running", "register", "unregister"]
