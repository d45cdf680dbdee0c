"""Stands in for a private module of the original Fiber."""


class Backend:
    def create_job(self) -> None: ...
