"""SE(3), fixed frames and the transport of covariances. NumPy only."""
