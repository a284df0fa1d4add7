"""Maps of other tools, in and out: COLMAP and hloc models with their descriptors, and foreign meshes."""
