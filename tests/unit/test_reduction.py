"""Pickling of objects: by reference, by value, with descriptors that never leak."""

from __future__ import annotations

import multiprocessing
import multiprocessing.reduction
import os
import pickle
import socket
import sys
import threading
from multiprocessing.queues import Queue
from typing import Any

import pytest

from fiber import reduction
from fiber._agent import child
from fiber._transport.channels import socketpair
from fiber._wire import packet
from fiber._wire.descriptor import Descriptor
from fiber.connection import Pipe
from fiber.errors import UnpicklableError
from fiber.process import Process


class Point:
    def __init__(self, x: int) -> None:
        self.x = x

    @classmethod
    def origin(cls) -> Point:
        return cls(0)


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_importable_objects_are_pickled_by_reference() -> None:
    data = reduction.dumps(Point.origin)
    assert b"cloudpickle" not in data
    assert pickle.loads(data)().x == 0


@pytest.mark.parametrize("make", [lambda: lambda: 42, lambda: type("Local", (), {"f": 42})])
def test_other_objects_are_pickled_by_value(make: Any) -> None:
    thing = pickle.loads(reduction.dumps(make()))
    assert (vars(thing)["f"] if isinstance(thing, type) else thing()) == 42


def test_plain_pickles_need_no_cloudpickle(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> None:
        raise AssertionError("cloudpickle was asked")

    monkeypatch.setattr(reduction, "_by_value_pickler", refuse)
    assert pickle.loads(reduction.dumps(Point.origin)).__self__ is Point  # a private reducer
    process = Process(target=os.getpid)
    payload, _ = reduction.dump_process(process, same_host=True)
    assert pickle.loads(payload).name == process.name


def test_the_error_is_about_the_object_not_about_the_second_try() -> None:
    with pytest.raises(TypeError, match=r"cannot pickle '_thread\.lock' object"):
        reduction.dumps([threading.Lock()])


def test_reducers_registered_with_multiprocessing_count(monkeypatch: pytest.MonkeyPatch) -> None:
    class Odd:
        def __reduce__(self) -> Any:
            raise TypeError("never this way")

    extra = multiprocessing.reduction.ForkingPickler._extra_reducers  # type: ignore[attr-defined]
    monkeypatch.setitem(extra, Odd, lambda _odd: (int, (7,)))
    assert pickle.loads(reduction.dumps(Odd())) == 7
    closure = Odd()
    assert pickle.loads(reduction.dumps(lambda: closure))() == 7


def test_encode_keeps_large_buffers_out_of_the_pickle() -> None:
    import numpy

    array = numpy.arange(100_000)
    payload, buffers = reduction.encode({"array": array})
    assert len(payload) < 1000
    assert sum(buffer.nbytes for buffer in buffers) == array.nbytes
    message = packet.Message(memoryview(payload), buffers, [])
    assert (packet.loads(message)["array"] == array).all()


def test_encode_falls_back_to_cloudpickle() -> None:
    value = 41
    payload, buffers = reduction.encode(lambda: value + 1)
    assert packet.loads(packet.Message(memoryview(payload), buffers, []))() == 42


# Descriptors that travel with a start


def test_descriptors_of_a_process_are_duplicated_for_as_long_as_they_are_kept(
    pipe: tuple[Any, Any],
) -> None:
    before = open_files()
    _, fds = reduction.dump_process(Process(target=print, args=pipe), same_host=True)
    assert len(fds) == 2
    assert open_files() == before + 2
    fds.clear()
    assert open_files() == before


def test_a_second_try_does_not_keep_the_descriptors_of_the_first(pipe: tuple[Any, Any]) -> None:
    before = open_files()
    one, other = pipe
    # The connection is reached first, then plain pickle fails at the lambda.
    process = Process(target=print, args=(one, other, lambda: None))
    payload, fds = reduction.dump_process(process, same_host=True)
    assert len(fds) == 2
    assert open_files() == before + 2
    assert payload


def test_a_failed_start_keeps_none(pipe: tuple[Any, Any]) -> None:
    before = open_files()
    with pytest.raises(TypeError):
        reduction.dump_process(
            Process(target=print, args=(*pipe, threading.Lock())), same_host=True
        )
    assert open_files() == before
    assert reduction.spawning() is None


def test_a_start_within_a_start_does_not_mix_them_up(pipe: tuple[Any, Any]) -> None:
    threads_fds: list[Descriptor] = []

    class Nested:
        def __reduce__(self) -> Any:
            def other_thread() -> None:
                process = Process(target=print, args=(pipe[0],))
                threads_fds.extend(reduction.dump_process(process, same_host=True)[1])

            thread = threading.Thread(target=other_thread)
            thread.start()
            thread.join()
            return int, (1,)

    _, fds = reduction.dump_process(Process(target=print, args=(Nested(), pipe[1])), same_host=True)
    assert (len(fds), len(threads_fds)) == (1, 1)


def test_a_descriptor_is_taken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    fd = os.dup(1)
    monkeypatch.setattr(child, "_descriptors", [fd])
    handle = reduction.PayloadDescriptor(0)
    assert handle.detach() == fd
    with pytest.raises(RuntimeError, match="descriptor 0 of the start message was taken twice"):
        handle.detach()
    os.close(fd)


def test_a_socket_goes_along_on_the_same_host_only() -> None:
    ours, theirs = socket.socketpair()
    process = Process(target=print, args=(ours,))
    _, fds = reduction.dump_process(process, same_host=True)
    assert len(fds) == 1
    before = open_files()
    with pytest.raises(UnpicklableError, match="cannot go to a process on another host") as caught:
        reduction.dump_process(process, same_host=False)
    assert caught.value.what == f"argument 0 of process {process.name!r}"
    assert "fiber.adopt()" in caught.value.reason
    assert open_files() == before
    ours.close()
    theirs.close()


def test_a_connection_cannot_be_pickled_by_just_anyone_without_a_trace() -> None:
    one, other = socketpair("a test")
    for sock in (one, other):
        sock.close()
    closed, open_end = Pipe()
    closed.close()
    with pytest.raises(OSError, match="handle is closed"):
        pickle.dumps(closed)
    open_end.close()


def test_open_files_are_refused_and_standard_streams_are_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stdout", sys.__stdout__)  # pytest's own is of another class
    with open(__file__) as file, pytest.raises(TypeError, match=r"open file .*pass its path"):
        reduction.dumps((lambda: None, file))
    function, stream = pickle.loads(reduction.dumps((lambda: 3, sys.stdout)))
    assert function() == 3
    assert stream is sys.stdout


def test_blame_names_the_argument_of_an_object_that_contains_itself() -> None:
    loop: list[Any] = [threading.Lock()]
    loop.insert(0, loop)
    error = reduction.blame({"it": loop}, TypeError("no"))
    assert isinstance(error, UnpicklableError)
    assert error.what == "it"


def test_blame_leaves_no_descriptor_of_a_multiprocessing_queue_open() -> None:
    theirs: Queue[int] = multiprocessing.Queue()
    before = open_files()
    error = reduction.blame({"it": [theirs]}, pickle.PicklingError("no"))
    assert isinstance(error, UnpicklableError)
    assert error.path == "[0]"
    assert "of multiprocessing" in error.reason
    assert open_files() == before


def test_blame_returns_other_errors_unchanged() -> None:
    reason = RuntimeError("the user's own")
    assert reduction.blame({"it": 1}, reason) is reason


def test_the_names_of_multiprocessings_module_are_there() -> None:
    assert set(multiprocessing.reduction.__all__) <= set(reduction.__all__)
