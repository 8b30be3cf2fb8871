"""Tools that stand on the core's public names and could be taken away, one by one."""
