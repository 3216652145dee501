"""gpvo.reproduce."""
