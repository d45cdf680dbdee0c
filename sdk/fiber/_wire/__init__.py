"""Formats of packets on one host, and of messages between hosts."""
