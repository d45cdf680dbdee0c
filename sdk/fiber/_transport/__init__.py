"""Transport of messages: sockets and counters on one host, nng between hosts, one event loop."""
