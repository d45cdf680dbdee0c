"""multiprocessing's classes of shared values, for annotations and ``isinstance``.

Fiber makes none of them yet: the functions refuse.
"""

from multiprocessing.sharedctypes import (
    Synchronized,
    SynchronizedArray,
    SynchronizedBase,
    SynchronizedString,
)

from fiber._hub.absent import absent

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

Value = absent("Value")
Array = absent("Array")
RawValue = absent("RawValue")
RawArray = absent("RawArray")
copy = absent("copy")
synchronized = absent("synchronized")
