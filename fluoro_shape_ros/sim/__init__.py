"""Robot shapes, C-arm geometry and two independent renderers with known truth."""
