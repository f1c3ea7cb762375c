"""Worker processes: feature prefetching and bundle adjustment in the background."""
