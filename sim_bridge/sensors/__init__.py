"""What sensors add to rendered images."""
