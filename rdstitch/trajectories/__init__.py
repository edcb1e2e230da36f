"""Poses of all images as a path: in the frame of the first or on a map, and beside the odometry of the robot."""
