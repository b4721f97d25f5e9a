"""What one image shows: the exposed field, lines, strips across a curve and their profiles."""
