"""Agent, zygote and child: the processes that run the children of one host."""
