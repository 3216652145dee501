"""Handing VO and its predicted error to other people's filters: ROS odometry, MAVLink, and what they do with it."""
