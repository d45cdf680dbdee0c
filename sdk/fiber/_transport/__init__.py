"""How it travels: unix sockets and event counters on one host, nng between hosts, one event loop."""
