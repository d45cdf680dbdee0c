"""The contract between the SDK and the operator: what a FiberPool is and what things are called.

Both sides import this package and neither imports the other.  ``names`` needs the standard library
alone, ``certificates`` needs cryptography, ``v1alpha1`` and ``schema`` need pydantic; this module
imports none of them.
"""
