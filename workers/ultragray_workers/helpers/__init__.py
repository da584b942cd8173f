"""Short work in a process of its own, within a bound of memory."""
