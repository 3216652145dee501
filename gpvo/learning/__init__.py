"""Training of error models: base variance, Gaussian processes, calibration and model cards."""
