"""The operator: makes the pods of a cluster match its FiberPools.  It knows nothing of tasks.

::

    watches ──► workqueue ──► controller ──► planning.reconcile.plan ──► Plan
    (kopf)                     │    ▲
                               ▼    │
                              cluster
                      (client of the API server)

``planning`` makes all decisions, without a clock, thread, socket, kopf or client.  ``cluster``
makes all calls to the API server.
"""
