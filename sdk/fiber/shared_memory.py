"""multiprocessing's classes of named shared memory, for annotations; Fiber makes none yet."""

from fiber._hub.unsupported import Unsupported

__all__ = ["ShareableList", "SharedMemory"]


class SharedMemory(Unsupported):
    pass


class ShareableList(Unsupported):
    pass
