"""An error-state Kalman filter for VO and an IMU, and the policies that state VO's noise. NumPy only."""
