"""Address of a buffer, and copies of it that let other threads of the interpreter run."""

from __future__ import annotations

import ctypes
from ctypes import pythonapi

_SIMPLE = 0


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


def copy(view: memoryview) -> bytes:
    """``bytes(view)``, during which other threads run: to copy a gigabyte takes a second."""
    made: bytes = _new_bytes(None, view.nbytes)
    if made:
        # A new object that no other code has seen may be written to.
        ctypes.memmove(_content(made), address(view), view.nbytes)
    return made
