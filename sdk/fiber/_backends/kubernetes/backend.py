"""The backend whose agents are pods: one FiberPool for each shape that a program asks for."""

from __future__ import annotations

import contextlib
from functools import partial

from fiber._agent.interface import ChildObserver, ChildSpec
from fiber._backends.kubernetes.pods import Pods
from fiber._backends.kubernetes.program import Program
from fiber._backends.kubernetes.shape import Shape
from fiber._backends.output import Output
from fiber._backends.remote import RemoteChild
from fiber._hub.hub import Hub
from fiber._transport.loop import Loop
from fiber.config import Config


class KubernetesBackend:
    """Shares the pods of each shape among all of the program's pools and processes."""

    name = "kubernetes"
    same_host = False
    same_pids = False
    elastic = True
    sends_program = True

    def __init__(self, loop: Loop, hub: Hub, config: Config) -> None:
        self._loop = loop
        self._hub = hub
        self._config = config
        self._output = Output()
        self._shape = Shape.of(config)
        self._program = Program(config)
        self._pods: dict[tuple[Shape | str, int], Pods] = {}
        """Pods by their shape or pool, and by the number of such pods before them."""
        self._closing = False

    def child(self, spec: ChildSpec, observer: ChildObserver) -> RemoteChild:
        """A child in a pod that has what it wishes."""
        pool = spec.resources.pool or self._config.pool
        key = pool or self._shape.with_resources(spec.resources)
        return self._find(key).agents.child(spec, observer)

    def _find(self, key: Shape | str) -> Pods:
        """Return the pods in use, or new ones.  There is no lock: a finalizer may call this too."""
        before = 0
        while True:
            pods = self._pods.get((key, before))
            if pods is None:  # one that another thread makes meanwhile has had no effect yet
                pods = self._pods.setdefault((key, before), self._make(key))
                if self._closing:  # which may have looked before
                    pods.begin_close()
            if not pods.over:
                return pods
            before += 1

    def _make(self, key: Shape | str) -> Pods:
        make = partial(Pods, self._loop, self._hub, self._output, self._config, self._program.api)
        if isinstance(key, str):
            return make(partial(self._program.prepare_warm, key, self._loop))
        prepare = partial(self._program.prepare_own, key, self._loop)
        return make(prepare, successor=lambda: self._find(key).agents)

    def close(self) -> None:
        """End the pods, and the pools or their use."""
        self._closing = True
        with contextlib.ExitStack() as rest:  # of which nothing is left out if it is interrupted
            rest.callback(self._output.close)
            rest.callback(self._program.close)
            for pods in list(self._pods.values()):
                pods.begin_close()
                rest.callback(pods.close)
