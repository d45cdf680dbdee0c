"""multiprocessing's classes of shared values, for annotations and ``isinstance``.

Fiber makes none of them yet: the functions refuse.
"""

from multiprocessing.sharedctypes import (
    Synchronized,
    SynchronizedArray,
    SynchronizedBase,
    SynchronizedString,
)

from fiber._hub.unsupported import unsupported

__all__ = [
    "Array",
    "RawArray",
    "RawValue",
    "Synchronized",
    "SynchronizedArray",
    "SynchronizedBase",
    "SynchronizedString",
    "Value",
    "copy",
    "synchronized",
]

Value = unsupported("Value")
Array = unsupported("Array")
RawValue = unsupported("RawValue")
RawArray = unsupported("RawArray")
copy = unsupported("copy")
synchronized = unsupported("synchronized")
