"""Poses of all images as a path: in a frame of the user, and beside the odometry of the robot that carried them."""
