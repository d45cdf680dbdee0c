"""Faults of an installation: packages that are missing, files of another distribution.

It is imported only where a fault is possible, and not by ``import fiber`` of a good installation.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

_INSTALLED_BY = {
    "gymnasium": "'fiberpool[vector]'",
    "joblib": "'fiberpool[joblib]'",
    "matplotlib": "matplotlib",
    "numpy": "'fiberpool[vector]'",
    "stable_baselines3": "stable-baselines3",
}

_REMEDY = "Run pip uninstall {others}, and then pip install --force-reinstall fiberpool."


@contextmanager
def explained_if_missing(feature: str) -> Iterator[None]:
    """Make ModuleNotFoundError for a package of an extra say that ``feature`` needs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in _INSTALLED_BY or importlib.util.find_spec(package) is not None:
            raise
        raise ModuleNotFoundError(
            f"{feature} needs the package {package}, which is not installed: "
            f"pip install {_INSTALLED_BY[package]}",
            name=error.name,
        ) from error


def warn_of_foreign_files(folder: str, names: Iterable[str]) -> None:
    """Warn that ``folder``, the package's, has modules that are not Fiber's."""
    import warnings

    others = _other_owners()
    owners = f"the distribution {' and '.join(others)}" if others else "no installed distribution"
    warnings.warn(
        f"the folder of Fiber, {folder}, has modules that are not Fiber's: "
        f"{', '.join(sorted(names))}. They belong to {owners}. Distributions with a package of the "
        "same name overwrite each other's files, and what is imported may be of either. "
        + _REMEDY.format(others=" ".join(others) or "what they were installed by"),
        RuntimeWarning,
        stacklevel=4,
    )


def overwritten() -> ImportError:
    """Return the error for a package ``fiber`` of which another distribution has replaced files."""
    others = _other_owners() or ["fiber"]
    return ImportError(
        f"the distribution {' and '.join(others)} has overwritten files of Fiber: both have a "
        "package fiber. " + _REMEDY.format(others=" ".join(others))
    )


def _other_owners() -> list[str]:
    from importlib import metadata

    owners = metadata.packages_distributions().get("fiber", ())
    return sorted({name for name in owners if name != "fiberpool"})
