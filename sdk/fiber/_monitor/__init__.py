"""Monitor of a program: what it does now, for other processes of the same user."""
