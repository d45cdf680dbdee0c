"""How long a test waits for a condition before it calls the program hung."""

PATIENCE = 60.0
"""Seconds.  A deadline tells a hang from slow work, on a busy machine too, and nothing else."""
