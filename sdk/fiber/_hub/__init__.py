"""Objects that live on one host and are used from others, and the handles that reach them."""
