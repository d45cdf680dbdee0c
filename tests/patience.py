"""Deadline of a test that waits for a condition: after it the program counts as hung."""

PATIENCE = 60.0
"""Seconds. A deadline only tells a hang from slow work, also on a busy machine."""
