"""Semaphores in shared memory whose tokens outlive nobody who held them."""
