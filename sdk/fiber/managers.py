"""Managers: not in this release."""
