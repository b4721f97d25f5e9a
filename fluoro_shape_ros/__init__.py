"""fluoro_shape_ros: the 3-D backbone and tip of a thin device from two X-ray views."""

__version__ = '0.1.0'
