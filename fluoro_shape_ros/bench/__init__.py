"""How accurate, how robust and how fast the reconstruction is, on scenes with known truth."""
