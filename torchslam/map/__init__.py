"""Atlas, submaps, maps and the map file: keyframes, map points, observations, posed frames, tracking state."""
