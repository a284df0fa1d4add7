"""What the mapping device and the photographer record."""
