"""gpvo.io."""
