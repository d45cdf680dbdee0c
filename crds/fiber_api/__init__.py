"""The contract between the SDK and the operator: what a FiberPool is and what things are called.

Both sides import this package and neither imports the other.  ``names``, ``identity`` and ``rest``
need the standard library alone, ``v1alpha1`` and ``schema`` need pydantic; this module imports none
of them.
"""
