"""Decisions of the operator: pure functions from what was seen to the work to do.

``reconcile.plan`` makes a ``plans.Plan``, which the controller carries out.  The modules use no
clock, thread, socket or client: the time and all observations are arguments.
"""
