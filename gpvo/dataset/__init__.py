"""gpvo.dataset."""
