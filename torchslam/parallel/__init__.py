"""Worker processes: feature prefetching, bundle adjustment in the background, and shared tasks."""
