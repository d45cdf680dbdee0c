"""Pickles of exceptions: an exception keeps its class and attributes, its traceback is text.

pickle rebuilds an exception by calling its class with ``args``.  That fails, or changes the
message, if ``__init__`` takes other arguments than those it passes on.  This module makes such an
exception by its native base alone, and sets its arguments and attributes afterwards.  A
``__reduce__`` in Python, or a function registered with copyreg, is used if it works.
"""

from __future__ import annotations

import copyreg
import io
import pickle
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from multiprocessing.reduction import ForkingPickler
from types import BuiltinFunctionType, MethodDescriptorType, WrapperDescriptorType
from typing import Any, NamedTuple, cast

from fiber._agent import by_reference
from fiber._exceptions import add_note, fields_of, group_of, make, set_fields
from fiber._hub.handles import collecting_grants

LINKS = 8
"""Number of causes and contexts that travel with an exception."""

_NATIVE = (BuiltinFunctionType, MethodDescriptorType, WrapperDescriptorType)

_Reduced = tuple[Any, ...] | str

_MakePickler = Callable[[io.BytesIO, dict[type, Any]], pickle.Pickler]


def encode_error(error: BaseException) -> bytes:
    """Pickle an error, with its traceback as text, in a form that always unpickles."""
    return pickle.dumps(Travelling(error))


def format_error(error: BaseException) -> str:
    """Return the traceback as text, also of an exception that raises while it is formatted."""
    import traceback  # rarely needed, and long to import

    try:
        return "".join(traceback.format_exception(error))
    except BaseException:  # traceback calls the __bool__ of exceptions
        frames = "".join(traceback.format_tb(_attribute(error, "__traceback__")))
        return f"Traceback (most recent call last):\n{frames}{_shown(error)}\n"


class Travelling:
    """Placeholder of an exception in a pickle: unpickling returns the exception itself.

    The ``__cause__`` of the result is multiprocessing's RemoteTraceback.  Causes and contexts are
    in the ``__context__`` of that.
    """

    def __init__(self, error: BaseException) -> None:
        self.text = format_error(error)
        # The frames would keep the task's objects alive.
        BaseException.with_traceback(error, None)
        self._shown = _shown(error)
        notes = _attribute(error, "__notes__")
        self._notes = [str(note) for note in notes] if isinstance(notes, list) else []
        self._data, self._reason = _pickled(error)
        self._links: list[tuple[str, bytes]] = []
        for name, link in _links(error):
            data, _ = _pickled(link)
            if data is None:
                break
            self._links.append((name, data))

    @property
    def whole(self) -> bool:
        """False if the exception cannot be sent, and an error that shows it is sent instead."""
        return self._data is not None

    def __reduce__(self) -> tuple[Any, ...]:
        parts = (self._data, self._reason, self._shown, self.text, self._notes, self._links)
        return _received, parts


def unsendable(reason: object, value: object) -> Exception:
    """Return multiprocessing's error for a value that does not pickle."""
    from multiprocessing.pool import MaybeEncodingError  # type: ignore[attr-defined]

    error: Exception = MaybeEncodingError(_Text(_shown(reason)), _Text(_shown(value)))
    return error


def _received(
    data: bytes | None,
    reason: str,
    shown: str,
    text: str,
    notes: list[str],
    links: list[tuple[str, bytes]],
) -> BaseException:
    from multiprocessing.pool import RemoteTraceback  # type: ignore[attr-defined]

    trace = RemoteTraceback(f'\n"""\n{text}"""')
    if data is None:
        error: BaseException = unsendable(_Text(reason), _Text(shown))
    else:
        try:
            error = _exception(pickle.loads(data))
        except Exception as refusal:
            error = unsendable(refusal, _Text(shown))
    if not getattr(error, "__notes__", None):
        for note in notes:
            add_note(error, note)
    last = trace
    with suppress(Exception):  # the text has them in any case
        for name, link in links:
            linked = _exception(pickle.loads(link))
            object.__setattr__(last, "__context__" if last is trace else name, linked)
            last = linked
    trace.__suppress_context__ = True  # the text shows them
    # A frozen dataclass refuses the assignment.
    object.__setattr__(error, "__cause__", trace)
    return error


def _exception(obj: Any) -> BaseException:
    if isinstance(obj, BaseException):
        return obj
    raise TypeError(f"an exception was pickled, and unpickling gives a {type(obj).__qualname__}")


def _links(error: BaseException) -> Iterator[tuple[str, BaseException]]:
    """Yield the causes of ``error``: each with the attribute of the one before that holds it."""
    seen = {id(error)}
    while len(seen) <= LINKS:
        name, link = "__cause__", _attribute(error, "__cause__")
        if link is None and not _attribute(error, "__suppress_context__"):
            name, link = "__context__", _attribute(error, "__context__")
        if not isinstance(link, BaseException) or id(link) in seen:
            return
        yield name, link
        seen.add(id(link))
        error = link


def _attribute(error: BaseException, name: str) -> Any:
    """Return an attribute without the ``__getattribute__`` of the class, which may raise; None if
    there is none.
    """
    try:
        return object.__getattribute__(error, name)
    except Exception:
        return None


def _pickled(error: BaseException) -> tuple[bytes | None, str]:
    """Return a pickle that was checked to unpickle; or None, and the reason."""
    reason = ""
    for pickler, incomplete in (
        (_by_name, False),
        (by_reference.pickler, False),
        (by_reference.pickler, True),
    ):
        try:
            return _Pickling(pickler, incomplete=incomplete).checked(error), ""
        except BaseException as refusal:  # kept as text: it would keep frames alive
            reason = _shown(refusal)
    return None, reason


def _by_name(file: io.BytesIO, reducers: dict[type, Any]) -> pickle.Pickler:
    pickler: Any = ForkingPickler(file, pickle.HIGHEST_PROTOCOL)
    pickler.dispatch_table = ChainMap(reducers, pickler.dispatch_table)
    made: pickle.Pickler = pickler
    return made


class _State(NamedTuple):
    """State of an exception that its native base rebuilds."""

    args: tuple[Any, ...]
    attributes: dict[str, Any]
    fields: dict[str, Any]
    for_setstate: bool
    """True if the class has a ``__setstate__`` that takes the attributes."""

    @classmethod
    def of(cls, error: BaseException) -> _State:
        own = _state_for_setstate(error)
        attributes = dict(vars(error) if own is None else own)
        return cls(error.args, attributes, _fields(error), own is not None)


class _Pickling:
    """Pickler of exceptions, and of objects that contain exceptions.

    With ``incomplete``, an exception travels without the parts that cannot travel, and has a note
    that says so.  A group gets another exception in place of a member that cannot travel.
    """

    def __init__(self, pickler: _MakePickler, *, incomplete: bool = False) -> None:
        self._pickler = pickler
        self._incomplete = incomplete
        self._by_own_reduce: dict[int, BaseException] = {}
        self._open: set[int] = set()
        """Exceptions whose parts are being checked."""
        self._met: set[int] = set()
        """Open exceptions that are parts of the one being checked."""
        self._checked: dict[int, tuple[BaseException, _Reduced]] = {}
        self._apart: set[int] | None = None
        """Groups whose members are being pickled separately; None while pickles are checked."""

    def checked(self, error: BaseException) -> bytes:
        """Pickle ``error``, and unpickle it as a check.

        The members of a group are then pickled separately, as only some may unpickle at the
        receiver.
        """
        data, has_handles = self._trial(error)
        if isinstance(error, BaseExceptionGroup):
            self._apart = set()
            return self._dumped(error)
        # The handles in a trial pickle end with the trial.
        return self._dumped(error) if has_handles else data

    def _trial(self, obj: Any) -> tuple[bytes, bool]:
        """Pickle and unpickle ``obj``; return the pickle, and whether it has handles."""
        with collecting_grants() as grants:
            data = self._dumped(obj)
            copy = pickle.loads(data)
            if isinstance(obj, BaseException):
                _exception(copy)
            has_handles = bool(grants)
            grants.release()
        return data, has_handles

    def _dumped(self, obj: Any) -> bytes:
        file = io.BytesIO()
        self._pickler(file, _Exceptions(self._reduce)).dump(obj)
        return file.getvalue()

    def _reduce(self, error: BaseException) -> _Reduced:
        reduced = self._reduce_whole(error)
        if self._apart is None or id(error) in self._apart:
            return reduced
        if isinstance(reduced, str) or reduced[0] is not make:
            return reduced
        _, (kind, group), state, *_ = reduced
        if not group:
            return reduced
        self._apart.add(id(error))  # A member may contain its group.
        try:
            members = {id(each): _Member(self._dumped(each), _shown(each)) for each in group[1]}
        finally:
            self._apart.remove(id(error))
        return _rebuilt(kind, *_with_members(group, _State(*state), members))

    def _reduce_whole(self, error: BaseException) -> _Reduced:
        kind = type(error)
        if id(error) in self._checked:
            return self._checked[id(error)][1]
        if id(error) in self._by_own_reduce or not (self._incomplete or _needs_rebuilding(error)):
            return _own_reduced(error)
        if _has_own_reduce(kind):
            self._by_own_reduce[id(error)] = error
            if not self._refusal(error):
                return _own_reduced(error)
            del self._by_own_reduce[id(error)]
        state = _State.of(error)
        if self._incomplete and id(error) not in self._open:
            return self._reduce_checked(error, state)
        self._met.add(id(error))
        return _rebuilt(kind, group_of(error), state)

    def _reduce_checked(self, error: BaseException, state: _State) -> _Reduced:
        """Reduce an exception to the parts that can travel.

        The outcome is kept, since a part is pickled again at each check of the whole.
        """
        met, self._met = self._met, set()
        self._open.add(id(error))
        try:
            group, state = self._without_refused_members(error, state)
            state = self._without_refused(state)
        finally:
            self._open.remove(id(error))
            is_in_cycle = bool(self._met)  # Then the outcome depends on where the check began.
            self._met = met | self._met - {id(error)}
        reduced = _rebuilt(type(error), group, state)
        if not is_in_cycle:
            self._checked[id(error)] = error, reduced
        return reduced

    def _without_refused_members(
        self, error: BaseException, state: _State
    ) -> tuple[tuple[Any, ...], _State]:
        """Replace the members of a group that cannot travel by errors that say why."""
        if not isinstance(error, BaseExceptionGroup):
            return (), state
        sent: dict[int, object] = {}
        for member in error.exceptions:
            refusal = self._refusal(member)
            sent[id(member)] = unsendable(_Text(refusal), member) if refusal else member
        return _with_members(group_of(error), state, sent)

    def _without_refused(self, state: _State) -> _State:
        """Drop attributes that cannot travel, and turn such arguments into text; note both."""
        notes = []
        for values in (state.attributes, state.fields):
            for name, value in [*values.items()]:
                if refusal := self._refusal(value):
                    del values[name]
                    notes.append(f"attribute {name!r} did not come along: {refusal}")
        kept = []
        for index, value in enumerate(state.args):
            refusal = self._refusal(value)
            kept.append(_shown(value) if refusal else value)
            if refusal:
                notes.append(f"argument {index} came as text: {refusal}")
        earlier = state.attributes.get("__notes__") or ()
        state.attributes["__notes__"] = [*earlier, *notes]
        return state._replace(args=tuple(kept))

    def _refusal(self, value: Any) -> str:
        try:
            self._trial(value)
        except BaseException as error:
            return _shown(error)
        return ""


class _Exceptions(dict[type, Callable[[Any], _Reduced]]):
    """Part of a dispatch table that has every class of exceptions."""

    def __init__(self, reduce: Callable[[Any], _Reduced]) -> None:
        self._reduce = reduce

    def __missing__(self, kind: type) -> Callable[[Any], _Reduced]:
        if issubclass(kind, BaseException):
            return self._reduce
        raise KeyError(kind)


class _Member:
    """Placeholder of a member of a group: if it does not unpickle, an error that shows it."""

    def __init__(self, data: bytes, shown: str) -> None:
        self._parts = data, shown

    def __reduce__(self) -> tuple[Any, ...]:
        return _received_member, self._parts


def _received_member(data: bytes, shown: str) -> BaseException:
    try:
        return _exception(pickle.loads(data))
    except Exception as refusal:
        return unsendable(refusal, _Text(shown))


def _with_members(
    group: tuple[Any, ...], state: _State, members: Mapping[int, object]
) -> tuple[tuple[Any, ...], _State]:
    """Put ``members`` in the places of the earlier members with these ids."""
    args = tuple(
        type(arg)(members.get(id(each), each) for each in arg)
        if type(arg) in (list, tuple)
        else arg
        for arg in state.args
    )
    fields = {name: value for name, value in state.fields.items() if name != "exceptions"}
    message, earlier = group
    group = message, tuple(members[id(member)] for member in earlier)
    return group, state._replace(args=args, fields=fields)


def _rebuilt(kind: type, group: tuple[Any, ...], state: _State) -> _Reduced:
    return make, (kind, group), tuple(state), None, None, _set_state


def _set_state(error: BaseException, state: tuple[Any, ...]) -> None:
    args, attributes, fields, for_setstate = state
    # A class that came by value has no slots: they are attributes there, and slots here.
    set_fields(error, {**attributes, **fields})
    if for_setstate:
        cast("Any", error).__setstate__(attributes)
    else:
        present = fields_of(error)
        rest = {name: value for name, value in attributes.items() if name not in present}
        vars(error).update(rest)
    object.__setattr__(error, "args", args)


def _state_for_setstate(error: BaseException) -> dict[str, Any] | None:
    """Return the attributes that a ``__setstate__`` in Python takes; None if it takes none.

    If the class has a ``__getstate__`` or a ``__reduce__`` too, its ``__setstate__`` takes their
    result, which need not be a dictionary.
    """
    kind = type(error)
    if isinstance(kind.__setstate__, _NATIVE) or _has_own_reduce(kind):
        return None
    if isinstance(kind.__getstate__, _NATIVE):
        return vars(error)
    state: object = error.__getstate__()
    return state if isinstance(state, dict) else None


def _needs_rebuilding(error: BaseException) -> bool:
    """Return whether plain pickle may run code in Python, or lose a field."""
    kind = type(error)
    methods = (kind.__new__, kind.__init__, kind.__reduce__)
    return (
        not all(isinstance(method, _NATIVE) for method in methods)
        or _has_own_reduce(kind)
        or bool(_fields(error))
    )


def _has_own_reduce(kind: type[BaseException]) -> bool:
    reduce: Any = kind.__reduce__
    return (
        kind in _registered
        or kind.__reduce_ex__ is not object.__reduce_ex__
        or not isinstance(reduce, _NATIVE)
        or getattr(reduce, "__objclass__", kind).__module__ != "builtins"
    )


def _own_reduced(error: BaseException) -> _Reduced:
    registered = _registered.get(type(error))
    return registered(error) if registered else error.__reduce_ex__(pickle.HIGHEST_PROTOCOL)


_registered: Mapping[type, Callable[[Any], _Reduced]] = ChainMap(
    cast("Any", ForkingPickler)._extra_reducers, cast("Any", copyreg.dispatch_table)
)


def _fields(error: BaseException) -> dict[str, Any]:
    fields = fields_of(error)
    # ``obj`` is where an attribute was looked up.  pickle leaves it out, too.
    return {name: value for name, value in fields.items() if name not in ("args", "obj")}


def _shown(value: object) -> str:
    try:
        return repr(value)
    except BaseException:  # an error message must not fail because of a repr
        return object.__repr__(value)


class _Text:
    """Object with a given repr."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text
