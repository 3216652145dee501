"""gpvo.online."""
