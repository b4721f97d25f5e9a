"""The command line tools around the node."""
