"""What other programs read: poses, places, layers, a map of ROS, a project of Hugin, drawings."""
