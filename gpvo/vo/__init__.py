"""gpvo.vo."""
