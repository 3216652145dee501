"""A process that runs: images or anyone's odometry in, odometry with its covariance out, on the wire."""
