"""multiprocessing's classes of named shared memory, for annotations; Fiber makes none yet."""

from fiber._hub.absent import Absent

__all__ = ["ShareableList", "SharedMemory"]


class SharedMemory(Absent):
    pass


class ShareableList(Absent):
    pass
