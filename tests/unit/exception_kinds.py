"""Exceptions of users, as programs define them."""

from __future__ import annotations

import copyreg
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn


class Diverged(Exception):
    """Exception whose ``__init__`` takes other arguments than it passes on."""

    def __init__(self, step: int, *, loss: float) -> None:
        super().__init__(f"loss {loss} at step {step}")
        self.step = step
        self.loss = loss


class Rewords(Exception):
    """Exception that can be called with what it passes on, and says something else then."""

    def __init__(self, code: object, detail: str = "no detail") -> None:
        super().__init__(f"{code}: {detail}")
        self.code = code


class Slotted(Exception):
    __slots__ = ("__hidden", "never_set", "step")

    def __init__(self, step: int, hidden: int) -> None:
        super().__init__("slotted")
        self.step = step
        self.__hidden = hidden

    def hidden(self) -> int:
        return self.__hidden


class Made(Exception):
    """Exception that has a ``__new__`` with other arguments."""

    def __new__(cls, *, step: int) -> Made:
        made = super().__new__(cls, f"step {step}")
        made.step = step
        return made

    def __init__(self, *, step: int) -> None:
        pass

    step: int


@dataclass
class Data(Exception):
    step: int
    loss: float = 0.0


@dataclass(frozen=True)
class Frozen(Exception):
    step: int


class NoDevice(OSError):
    def __init__(self, device: str) -> None:
        super().__init__(19, "no such device", device)
        self.device = device


class NoText(UnicodeDecodeError):
    def __init__(self, line: int) -> None:
        super().__init__("utf-8", b"\xff", 0, 1, "invalid")
        self.line = line


class Stop(StopIteration):
    def __init__(self, *, value: int) -> None:
        super().__init__(value)


class NoModule(ImportError):
    def __init__(self, module: str, *, why: str) -> None:
        super().__init__(why, name=module, path="/nowhere")


class NoSyntax(SyntaxError):
    def __init__(self, line: int) -> None:
        super().__init__("no syntax", ("file", line, 2, "text", line, 3))


class Two(KeyError, AttributeError):
    def __init__(self, key: str, *, name: str) -> None:
        AttributeError.__init__(self, key, name=name)


class Missing(KeyError, OSError):
    """Instances have the fields of the second base."""


class Several(ExceptionGroup[Exception]):
    def __new__(cls, errors: list[Exception], *, step: int) -> Several:
        made = super().__new__(cls, f"several at {step}", errors)
        made.step = step
        return made

    def __init__(self, errors: list[Exception], *, step: int) -> None:
        pass

    step: int


class Reduced(Exception):
    """Exception whose own ``__reduce__`` works, and leaves out what is not to travel."""

    def __init__(self, step: int, secret: str) -> None:
        super().__init__(step, secret)
        self.step = step
        self.secret = secret

    def __reduce__(self) -> tuple[Any, ...]:
        return Reduced, (self.step, "left out")


class Registered(Exception):
    def __init__(self, step: int, secret: str) -> None:
        super().__init__(step, secret)
        self.secret = secret


copyreg.pickle(Registered, lambda error: (Registered, (error.args[0], "left out")))


class BadlyReduced(Exception):
    """Exception whose own ``__reduce__`` pickles, but fails when it is unpickled."""

    def __init__(self, step: int, loss: float) -> None:
        super().__init__("badly reduced")
        self.step = step
        self.loss = loss

    def __reduce__(self) -> tuple[Any, ...]:
        return BadlyReduced, (self.step,)


class Refusing(Exception):
    def __reduce__(self) -> tuple[Any, ...]:
        raise TypeError("it does not like to be pickled")


class WithState(Exception):
    """Exception that has a ``__setstate__``, which pickle calls."""

    def __init__(self, step: int, loss: float) -> None:
        super().__init__("with state")
        self.step = step

    def __setstate__(self, state: Any) -> None:
        self.step = state["step"] + 1


@dataclass(frozen=True, slots=True)
class FrozenSlots(Exception):
    """Exception that has a ``__getstate__`` and a ``__setstate__`` of dataclasses: for a list."""

    step: int
    loss: float


class HasLock(Exception):
    """Exception that makes its lock again in its ``__setstate__``."""

    def __init__(self, step: int) -> None:
        super().__init__("has a lock")
        self.step = step
        self.lock = threading.Lock()

    def __getstate__(self) -> dict[str, Any]:
        return {"step": self.step}

    def __setstate__(self, state: Any) -> None:
        self.step = state["step"]
        self.lock = threading.Lock()


class ReducedToList(Exception):
    """Exception whose ``__setstate__`` takes a list, and whose ``__reduce__`` fails later."""

    def __init__(self, step: int) -> None:
        super().__init__("reduced to a list")
        self.step = step

    def __reduce__(self) -> tuple[Any, ...]:
        return ReducedToList, (), [self.step]

    def __setstate__(self, state: Any) -> None:
        (self.step,) = state


class Untrue(Exception):
    """Exception that has no truth value."""

    def __bool__(self) -> bool:
        raise TypeError("it is neither true nor false")


class Wraps(Exception):
    """Exception with another one for an attribute, which refers back to it."""

    def __init__(self, inner: Exception, *, step: int) -> None:
        super().__init__("wraps")
        self.inner = inner
        self.step = step
        inner.outer = self  # type: ignore[attr-defined]


class Holding(Exception):
    """Exception that holds what cannot be pickled."""

    def __init__(self, step: int) -> None:
        super().__init__("holds", threading.Lock())
        self.lock = threading.Lock()
        self.step = step


class Chained(Exception):
    """Exception that holds the exception that it replaces."""

    def __init__(self, replaces: object) -> None:
        super().__init__("chained")
        self.replaces = replaces


class ReducedChain(Chained):
    def __reduce__(self) -> tuple[Any, ...]:
        return ReducedChain, (self.replaces,), vars(self)


class CountsPickles:
    """Object that cannot be pickled, and counts the attempts."""

    attempts = 0

    def __reduce__(self) -> NoReturn:
        self.attempts += 1
        raise TypeError("cannot be pickled")


class Unreadable(Exception):
    """An error whose own attributes cannot be read."""

    def __getattribute__(self, name: str) -> Any:
        if name == "__class__":
            return type(self)
        raise RuntimeError(f"{name} is not to be read")


class Hopeless(Exception):
    """Exception that cannot be unpickled."""

    def __setstate__(self, state: Any) -> None:
        raise LookupError("its state cannot be set")


def local(step: int) -> Exception:
    class Local(Exception):
        def __init__(self, step: int, *, loss: float) -> None:
            super().__init__("local")
            self.step = step
            self.loss = loss

    return Local(step, loss=0.5)


def throw(make: Callable[[], BaseException]) -> NoReturn:
    raise make()
