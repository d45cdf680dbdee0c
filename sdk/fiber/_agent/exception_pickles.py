"""Pickles of exceptions: an exception keeps its class and attributes, its traceback is text.

pickle rebuilds an exception by calling its class with ``args``.  That fails, or changes the
message, if ``__init__`` takes other arguments than those it passes on.  This module makes such an
exception by its native base alone, and sets its arguments and attributes afterwards.  A
``__reduce__`` in Python, or a function registered with copyreg, is used if it works.
"""

from __future__ import annotations

import builtins
import copyreg
import io
import pickle
from collections import ChainMap
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from multiprocessing.reduction import ForkingPickler
from types import BuiltinFunctionType, MethodDescriptorType, WrapperDescriptorType
from typing import Any, NamedTuple, cast

from fiber import _worker_images
from fiber._agent import by_reference
from fiber._exceptions import add_note, advice_on_main, fields_of, group_of, make, set_fields
from fiber._hub.handles import collecting_grants

LINKS = 8
"""Number of causes and contexts that travel with an exception."""

_NATIVE = (BuiltinFunctionType, MethodDescriptorType, WrapperDescriptorType)

_Reduced = tuple[Any, ...] | str

_Reduce = Callable[[Any], _Reduced]

_MakePickler = Callable[[io.BytesIO, _Reduce], pickle.Pickler]

_PLAIN_TYPES = frozenset((type(None), bool, int, float, complex, str, bytes))

_PLAIN_ERRORS = frozenset(
    kind
    for kind in vars(builtins).values()
    if isinstance(kind, type)
    and issubclass(kind, BaseException)
    and not issubclass(kind, BaseExceptionGroup)
)


def encode_error(error: BaseException) -> bytes:
    """Pickle an error, with its traceback as text, in a form that always unpickles."""
    return pickle.dumps(PickledException(error))


def format_error(error: BaseException) -> str:
    """Return the traceback as text, also of an exception that raises while it is formatted."""
    import traceback  # rarely needed, and long to import

    try:
        return "".join(traceback.format_exception(error))
    except BaseException:  # traceback calls the __bool__ of exceptions
        frames = "".join(traceback.format_tb(_attribute(error, "__traceback__")))
        return f"Traceback (most recent call last):\n{frames}{_shown(error)}\n"


class PickledException:
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
    module = _worker_images.missing_module(error)
    if advice := _worker_images.advice(module) or advice_on_main(error):
        add_note(error, advice)
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
    """Return a pickle that is known to unpickle; or None, and the reason."""
    if _is_plain(error) and not _fields(error):
        return pickle.dumps(error, pickle.HIGHEST_PROTOCOL), ""
    pickled = _Whole().pickled(error)
    return pickled.data, pickled.reason


def _by_name(file: io.BytesIO, reduce: _Reduce) -> pickle.Pickler:
    pickler: Any = pickle.Pickler(file, pickle.HIGHEST_PROTOCOL)
    pickler.dispatch_table = _Exceptions(reduce, _registered)
    made: pickle.Pickler = pickler
    return made


def _by_reference(file: io.BytesIO, reduce: _Reduce) -> pickle.Pickler:
    return by_reference.pickler(file, _Exceptions(reduce, {}))


class _ExceptionState(NamedTuple):
    """State of an exception that its native base rebuilds."""

    args: tuple[Any, ...]
    attributes: dict[str, Any]
    fields: dict[str, Any]
    for_setstate: bool
    """True if the class has a ``__setstate__`` that takes the attributes."""

    @classmethod
    def of(cls, error: BaseException) -> _ExceptionState:
        own = _state_for_setstate(error)
        attributes = dict(vars(error) if own is None else own)
        fields = _fields(error)
        if isinstance(error, BaseExceptionGroup):
            fields.pop("exceptions")  # It is made with them.
        return cls(error.args, attributes, fields, own is not None)


class _Pickled(NamedTuple):
    data: bytes | None
    """None: the exception cannot travel."""
    reason: str
    way: _Pickling | None = None
    """Set if the pickle has handles. It can be used once then, and the next is made this way."""


class _Whole:
    """Exception with everything in it.

    The members of a group are pickled separately, each in the first way that works for it, since
    only some may unpickle at the receiver.  Plain members unpickle everywhere, and stay in the
    pickle of their group.
    """

    def __init__(self) -> None:
        self.separate: dict[int, int] = {}
        """Group of each member that the present pickle has as a pickle in it."""
        self.open: set[int] = set()
        """Groups of which a member is being pickled: the member may contain its group."""
        self.reduced: dict[int, tuple[BaseException, _Reduced]] = {}
        """Exceptions reduced to the parts that can travel."""
        self._pickled: dict[int, tuple[BaseException, _Pickled]] = {}
        self._kinds: dict[type, _Kind | None] = {}
        self._plainly = _Pickling(_by_name, self)

    def member(self, error: BaseException) -> _Reduced:
        """Reduce a separate member to its pickle, or to its state if that is plain."""
        if _has_plain_state(error) and (kind := self._kind(type(error))) is not None:
            return _received_of_kind, (kind, tuple(_ExceptionState.of(error)), _shown(error))
        group = self.separate[id(error)]
        separate, self.separate = self.separate, {}
        self.open.add(group)
        try:
            pickled = self.pickled(error)
        finally:
            self.separate = separate
            self.open.discard(group)
        return _received_member, (pickled.data, pickled.reason, _shown(error))

    def _kind(self, kind: type[BaseException]) -> _Kind | None:
        if kind not in self._kinds:
            self._kinds[kind] = None
            for dumps in (pickle.dumps, by_reference.dumps):
                with suppress(Exception):
                    data = dumps(kind)
                    if pickle.loads(data) is kind:
                        self._kinds[kind] = _Kind(data)
                        break
        return self._kinds[kind]

    def pickled(self, error: BaseException) -> _Pickled:
        """Pickle ``error``, and check that the pickle unpickles if no earlier one was checked."""
        _, known = self._pickled.get(id(error), (None, None))
        if known is not None:
            return known if known.way is None else _Pickled(known.way.dumped(error), "")
        pickled = self._checked(error)
        self._pickled[id(error)] = error, pickled
        return pickled

    def _checked(self, error: BaseException) -> _Pickled:
        reason = ""
        for way in self._ways():
            try:
                if _is_plain(error):
                    return _Pickled(way.dumped(error), "")
                data, has_handles = way.checked(error)
                return _Pickled(data, "", way if has_handles else None)
            except BaseException as refusal:  # kept as text: it would keep frames alive
                reason = _shown(refusal)
        return _Pickled(None, reason)

    def _ways(self) -> Iterator[_Pickling]:
        yield self._plainly
        yield _Pickling(_by_reference, self)
        yield _Pickling(_by_reference, self, incomplete=True)


class _Pickling:
    """Pickler of exceptions, and of objects that contain exceptions.

    With ``incomplete``, an exception travels without the parts that cannot travel, and has a note
    that says so.
    """

    def __init__(self, pickler: _MakePickler, whole: _Whole, *, incomplete: bool = False) -> None:
        self._pickler = pickler
        self._whole = whole
        self._incomplete = incomplete
        self._own_reduce_works: dict[int, tuple[BaseException, bool]] = {}
        self._open: set[int] = set()
        """Exceptions whose parts are being checked."""
        self._idle: tuple[io.BytesIO, pickle.Pickler] | None = None

    def checked(self, error: BaseException) -> tuple[bytes, bool]:
        """Pickle ``error``, and unpickle it as a check; return whether the pickle has handles."""
        data, has_handles = self._trial(error)
        # The handles in a trial pickle end with the trial.
        return self.dumped(error) if has_handles else data, has_handles

    def dumped(self, obj: Any) -> bytes:
        """Pickle ``obj``."""
        (file, pickler), self._idle = self._idle or self._made(), None
        pickler.dump(obj)
        data = file.getvalue()
        if self._pickler is _by_name:  # A pickler of cloudpickle is for one pickle.
            pickler.clear_memo()
            file.seek(0)
            file.truncate()
            self._idle = file, pickler
        return data

    def _made(self) -> tuple[io.BytesIO, pickle.Pickler]:
        file = io.BytesIO()
        return file, self._pickler(file, self._reduce)

    def _trial(self, obj: Any) -> tuple[bytes, bool]:
        """Pickle and unpickle ``obj``; return the pickle, and whether it has handles."""
        with collecting_grants() as grants:
            data = self.dumped(obj)
            copy = pickle.loads(data)
            if isinstance(obj, BaseException):
                _exception(copy)
            has_handles = bool(grants)
            grants.release()
        return data, has_handles

    def _reduce(self, error: BaseException) -> _Reduced:
        if id(error) in self._whole.separate:
            return self._whole.member(error)
        if id(error) in self._open:  # It is checked already, and need not be complete here.
            return make, (type(error), group_of(error))
        if self._incomplete and id(error) in self._whole.reduced:
            return self._whole.reduced[id(error)][1]
        if not (self._incomplete or _needs_rebuilding(error)):
            return _own_reduced(error)
        if _has_own_reduce(type(error)) and self._reduces_itself(error):
            return _own_reduced(error)
        group = group_of(error)
        if group and id(error) not in self._whole.open:
            others = (member for member in group[1] if not _is_plain(member))
            self._whole.separate.update((id(member), id(error)) for member in others)
        state = _ExceptionState.of(error)
        if self._incomplete:
            state = self._without_refused(error, state)
        reduced = make, (type(error), group), tuple(state), None, None, _set_state
        if self._incomplete:
            # A part is pickled again at each check of what contains it.
            self._whole.reduced[id(error)] = error, reduced
        return reduced

    def _reduces_itself(self, error: BaseException) -> bool:
        """Return whether the ``__reduce__`` of the program works."""
        if id(error) not in self._own_reduce_works:
            self._own_reduce_works[id(error)] = error, True  # for the check
            self._own_reduce_works[id(error)] = error, not self._refusal(error)
        return self._own_reduce_works[id(error)][1]

    def _without_refused(self, error: BaseException, state: _ExceptionState) -> _ExceptionState:
        """Drop attributes that cannot travel, and turn such arguments into text; note both."""
        self._open.add(id(error))
        try:
            return self._parts(state)
        finally:
            self._open.remove(id(error))

    def _parts(self, state: _ExceptionState) -> _ExceptionState:
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
        if type(value) in _PLAIN_TYPES:
            return ""
        try:
            self._trial(value)
        except BaseException as error:
            return _shown(error)
        return ""


class _Exceptions(dict[type, Callable[[Any], _Reduced]]):
    """Dispatch table that has every class of exceptions, and what is in ``others``."""

    def __init__(self, reduce: _Reduce, others: Mapping[type, Callable[[Any], _Reduced]]) -> None:
        self._reduce = reduce
        self._others = others

    def __missing__(self, kind: type) -> Callable[[Any], _Reduced]:
        return self._reduce if issubclass(kind, BaseException) else self._others[kind]


class _Kind:
    """Placeholder of a class in a pickle: if it does not unpickle, a text that says why."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def __reduce__(self) -> tuple[Any, ...]:
        return _received_kind, (self._data,)


def _received_kind(data: bytes) -> Any:
    try:
        return pickle.loads(data)
    except Exception as refusal:
        return _Text(_shown(refusal))


def _received_of_kind(kind: Any, state: tuple[Any, ...], shown: str) -> BaseException:
    """Return a member of a group that has a plain state, as ``_received_member`` does."""
    try:
        error: BaseException = make(kind, ())
        _set_state(error, state)
    except Exception as refusal:
        return unsendable(kind if isinstance(kind, _Text) else refusal, _Text(shown))
    return error


def _received_member(data: bytes | None, reason: str, shown: str) -> BaseException:
    """Return a member of a group: if it does not unpickle, an error that shows it."""
    if data is None:
        return unsendable(_Text(reason), _Text(shown))
    try:
        return _exception(pickle.loads(data))
    except Exception as refusal:
        return unsendable(refusal, _Text(shown))


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


def _is_plain(error: BaseException) -> bool:
    """Return whether ``error`` unpickles in every process: no code of the program takes part."""
    kind = type(error)
    if kind not in _PLAIN_ERRORS or _reducer(kind):
        return False
    return _has_plain_values(error)


def _has_plain_state(error: BaseException) -> bool:
    """Return whether only the class of ``error`` can keep it from being made again."""
    kind = type(error)
    return (
        not isinstance(error, BaseExceptionGroup)
        and all(
            isinstance(method, _NATIVE) for method in (kind.__setstate__, kind.__getattribute__)
        )
        and not _has_own_reduce(kind)
        and _has_plain_values(error)
    )


def _has_plain_values(error: BaseException) -> bool:
    attributes = {**vars(error), **_fields(error)}
    notes = attributes.pop("__notes__", [])
    values = (*error.args, *attributes.values(), *(notes if type(notes) is list else (notes,)))
    return all(type(value) in _PLAIN_TYPES for value in values)


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
        _reducer(kind) is not None
        or kind.__reduce_ex__ is not object.__reduce_ex__
        or not isinstance(reduce, _NATIVE)
        or getattr(reduce, "__objclass__", kind).__module__ != "builtins"
    )


def _own_reduced(error: BaseException) -> _Reduced:
    reducer = _reducer(type(error))
    return reducer(error) if reducer else error.__reduce_ex__(pickle.HIGHEST_PROTOCOL)


def _reducer(kind: type) -> Callable[[Any], _Reduced] | None:
    """Return the function that is registered for instances of ``kind``."""
    tables: tuple[Any, ...] = cast("Any", ForkingPickler)._extra_reducers, copyreg.dispatch_table
    return next((table[kind] for table in tables if kind in table), None)


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
