"""gpvo.evaluation."""
