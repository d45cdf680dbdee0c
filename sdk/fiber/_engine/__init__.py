"""Pure decisions: no clock, no thread, no socket.  ``now`` is an argument."""
