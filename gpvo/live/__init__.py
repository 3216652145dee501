"""``gpvo live``: images or anyone's odometry in, odometry with its covariance out, as messages."""
