"""Where the device may be: first curves in space."""
