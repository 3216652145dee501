"""Twins: a run simulated again from its own path, landmarks and pixel residuals, so that its truth is known."""
