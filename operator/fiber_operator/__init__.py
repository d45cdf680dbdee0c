"""The operator: makes the pods of a cluster match its FiberPools.  It knows nothing of tasks.

::

    handlers ─► worker ─► controller ─► reconcile.plan ─► Plan
    (kopf)     (queue)     │  ▲             pure: pods, failures, problems,
                           ▼  │                   status, manifests
                          cluster
                    (the API's only door)

What is decided is decided by pure modules, which know no clock, thread, socket, kopf or client;
what is done is done through ``cluster``.
"""
