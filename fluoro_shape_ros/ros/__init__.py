"""The ROS side: the node, what it listens to and publishes, which images pair, and the thread that does the work."""
