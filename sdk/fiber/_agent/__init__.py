"""What runs beside the children of one host: agent, zygote, and the child's own first steps."""
