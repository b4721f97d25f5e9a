"""Cameras, epipolar geometry, curves and splines."""
