"""A process that runs: pictures or anyone's odometry in, odometry with its covariance out, on the wire."""
