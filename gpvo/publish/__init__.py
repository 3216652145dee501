"""gpvo.publish."""
