"""Backends: children of this process, of agents on this machine, and in pods."""
