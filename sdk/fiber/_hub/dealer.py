"""A queue's items are dealt to its readers in turn, before they ask.

::

    put ── inbox ──► Dealer, a thread of the queue's maker ──┬─► a reader's own channel ──► get
                           ▲                                 └─► another reader's
    the first get ── arrivals

"""

from __future__ import annotations

import pickle
import select
import threading
from collections import deque

from fiber._hub import one_way
from fiber._hub.handles import collecting_grants
from fiber._hub.local import LocalChannel
from fiber._hub.one_way import Receiver, Sender
from fiber._hub.remote import RemoteObject
from fiber._transport.channels import Channel
from fiber._wire import packet
from fiber._wire.packet import Message
from fiber.errors import ConnectionClosed

_LOOK_AGAIN = 0.5
"""Seconds after which a reader that arrives looks whether anybody is there."""


class Dealer:
    """Deals what comes by ``inbox`` to those who come by ``arrivals``, until ``inbox`` ends.

    Each item goes to the next reader that has room for it; without one it waits, and the others
    behind it in ``inbox``.
    """

    def __init__(self, inbox: Receiver, arrivals: LocalChannel) -> None:
        self._inbox = inbox
        self._arrivals = arrivals
        self._readers: deque[Sender] = deque()
        self._item: Message | None = None

    def start(self) -> None:
        """Start dealing on a daemon thread."""
        threading.Thread(target=self._run, name="fiber-dealer", daemon=True).start()

    def _run(self) -> None:
        try:
            while True:
                self._wait()
                if self._arrivals.poll(0):
                    self._welcome()
                if self._item is None:
                    self._item = self._inbox.try_recv()
                if self._item is not None and self._deal(self._item):
                    self._item.release()
                    self._item = None
        except ConnectionClosed:  # nobody has the queue any more
            pass
        finally:
            for channel in (self._inbox, self._arrivals, *self._readers):
                channel.close()

    def _wait(self) -> None:
        poller = select.poll()
        poller.register(self._arrivals.fileno(), select.POLLIN)
        timeout = None
        if self._item is None:
            poller.register(self._inbox.fileno(), select.POLLIN)
            timeout = one_way.LOOK_AGAIN * 1000
        else:
            for reader in self._readers:
                poller.register(reader.fileno(), reader.room_events)
        poller.poll(timeout)

    def _welcome(self) -> None:
        message = self._arrivals.try_recv()
        if message is None:
            return
        try:
            answer: Channel = packet.loads(message)
        except Exception:  # the reader is gone already
            return
        theirs, ours = one_way.pair()
        with collecting_grants(reusable=False) as grants:
            invitation = pickle.dumps(theirs)
        try:
            answer.send(invitation)
            answer.recv().release()  # it has it
            self._readers.append(ours)
        except (OSError, ConnectionClosed):
            ours.close()
        finally:
            grants.release()
            theirs.close()
            answer.close()

    def _deal(self, item: Message) -> bool:
        """Deal an item to a reader with room; return False if there was none."""
        for _ in range(len(self._readers)):
            reader = self._readers.popleft()
            try:
                dealt = reader.try_send(item.payload, item.buffers)
            except BrokenPipeError:  # it is gone
                reader.close()
                continue
            self._readers.append(reader)
            if dealt:
                return True
        return False


def arrive(arrivals: Channel) -> Channel:
    """Become a reader: the channel on which the dealer sends.  ConnectionClosed if it is gone."""
    ours, theirs = LocalChannel.pair()
    with collecting_grants(reusable=False) as grants:
        invitation = pickle.dumps(theirs)
    theirs.close()
    try:
        arrivals.send(invitation)
        while not ours.poll(_LOOK_AGAIN):
            if arrivals.poll(0):  # nothing ever comes there but the end
                raise ConnectionClosed()
        channel: Channel = ours.recv_object()
        if isinstance(channel, RemoteObject):  # or the grant might be taken back before
            channel.confirm()
        ours.send(b"")
        return channel
    except BrokenPipeError as error:
        raise ConnectionClosed() from error
    finally:
        grants.release()
        ours.close()
