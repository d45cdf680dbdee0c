"""What the operator decides: pure, from what is there to what is to be done.

``reconcile.plan`` is the whole of it.  No clock, no thread, no socket, no client: ``now`` and all
that was seen are arguments, and what comes out is a ``plans.Plan`` that the controller carries out.
"""
