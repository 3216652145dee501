"""Ground truth beside VO logs: errors of motions, training sets, and splits by sequence."""
