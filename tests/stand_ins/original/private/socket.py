"""Stands in for a private module of the original Fiber."""


class Socket: ...
