"""The operator: makes the pods of a cluster match its FiberPools.  It knows nothing of tasks.

::

    handlers ─► turns ─► controller ─► planning.reconcile.plan ─► Plan
    (kopf)     (queue)    │  ▲
                          ▼  │
                         cluster
                   (the API's only door)

What is decided is decided in ``planning``, which knows no clock, thread, socket, kopf or client;
what is done is done through ``cluster``.
"""
