"""Demonstrations on real topics: one that watches, one that closes its loop."""
