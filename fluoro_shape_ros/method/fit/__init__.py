"""A curve brought to rest on both images."""
