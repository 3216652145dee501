"""gpvo.cameras."""
