"""Free functions between ROS messages and arrays; usable without a running node."""
