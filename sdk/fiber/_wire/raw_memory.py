"""Address of a buffer, and copies of it that let other threads of the interpreter run."""

from __future__ import annotations

import ctypes
import mmap
import os
from ctypes import pythonapi

from fiber._wire.arena import HUGE_PAGES_UP_TO, Mapping

_SIMPLE = 0

_MAPPED = 1 << 25
"""Bytes from which the C library gives an object memory that belongs to no other."""

_STEP = 1 << 26
"""Bytes that one system call copies."""


class _Buffer(ctypes.Structure):
    """``Py_buffer`` of the stable C API."""

    _fields_ = (
        ("buf", ctypes.c_void_p),
        ("obj", ctypes.c_void_p),
        ("len", ctypes.c_ssize_t),
        ("itemsize", ctypes.c_ssize_t),
        ("readonly", ctypes.c_int),
        ("ndim", ctypes.c_int),
        ("format", ctypes.c_char_p),
        ("shape", ctypes.c_void_p),
        ("strides", ctypes.c_void_p),
        ("suboffsets", ctypes.c_void_p),
        ("internal", ctypes.c_void_p),
    )


_new_bytes = pythonapi.PyBytes_FromStringAndSize
_new_bytes.argtypes = ctypes.c_char_p, ctypes.c_ssize_t
_new_bytes.restype = ctypes.py_object

_content = pythonapi.PyBytes_AsString
_content.argtypes = (ctypes.py_object,)
_content.restype = ctypes.c_void_p


def address(view: memoryview) -> int:
    """Return the address of ``view``'s memory, valid for as long as ``view`` exists."""
    buffer = _Buffer()
    pythonapi.PyObject_GetBuffer(ctypes.py_object(view), ctypes.byref(buffer), _SIMPLE)
    try:
        return buffer.buf or 0
    finally:
        pythonapi.PyBuffer_Release(ctypes.byref(buffer))


_advise = ctypes.CDLL(None).madvise
_advise.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int


def copy(view: memoryview) -> bytes:
    """``bytes(view)``, during which other threads run: to copy a gigabyte takes a second."""
    size = view.nbytes
    made: bytes = _new_bytes(None, size)
    if not made:
        return made
    # A new object that no other code has seen may be written to.
    target = _content(made)
    if _MAPPED <= size <= HUGE_PAGES_UP_TO:
        _use_huge_pages(target, size)
    memory = view.obj
    if isinstance(memory, Mapping) and memory.owner is not None:
        # A read faults no page of the mapping, which would cost as much as the copy.
        offset = address(view) - address(memoryview(memory))
        _read(memory.owner.fileno(), offset, target, size)
    else:
        ctypes.memmove(target, address(view), size)
    return made


def _use_huge_pages(start: int, size: int) -> None:
    begin = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
    _advise(begin, start + size - begin, mmap.MADV_HUGEPAGE)  # fails where a kernel has none


def _read(fd: int, offset: int, target: int, size: int) -> None:
    """Read from a file to ``target``; ValueError if it ends too early."""
    view = memoryview((ctypes.c_char * size).from_address(target)).cast("B")
    done = 0
    while done < size:
        read = os.preadv(fd, [view[done : done + _STEP]], offset + done)
        if not read:
            raise ValueError(f"a large message ends after {done} of {size} bytes")
        done += read
