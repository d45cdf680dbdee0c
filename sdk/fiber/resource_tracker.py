"""multiprocessing's tracker of named shared memory.  Fiber itself has nothing for it to track."""

from multiprocessing.resource_tracker import ensure_running, register, unregister

__all__ = ["ensure_running", "register", "unregister"]
