"""What travels: packets on one host, messages between hosts.  Knows nothing of who sends them."""
