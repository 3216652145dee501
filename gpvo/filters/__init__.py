"""gpvo.filters."""
