"""Bundle adjustment of poses, points and cameras: sparse, dense in batches, and the NumPy backend of tracking."""
