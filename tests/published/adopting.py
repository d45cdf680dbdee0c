"""Plugin of pytest: the modules in PUBLISHED_ADOPT use Fiber, from before any test is imported."""

from __future__ import annotations

import os


def pytest_configure() -> None:
    """Let the named modules use Fiber."""
    modules = [name for name in os.environ["PUBLISHED_ADOPT"].split(",") if name]
    if modules:
        import fiber

        for module in modules:
            fiber.adopt(module)
