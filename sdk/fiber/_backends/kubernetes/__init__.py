"""Pods as processes: a FiberPool per program and shape, and what it takes to hold one."""
