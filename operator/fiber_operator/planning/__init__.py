"""Decisions of the operator: pure functions from the state to the work to do.

``reconcile.plan`` is the whole of it.  No clock, no thread, no socket, no client: ``now`` and all
that was seen are arguments, and what comes out is a ``plans.Plan`` that the controller carries out.
"""
