"""The scene made ready for a field day: free floor, paths, tags and waypoints."""
