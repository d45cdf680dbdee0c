"""Stands in for the package requests in tests that only import it."""
