"""Agents that are pods: FiberPools, which Fiber's operator turns into them."""
