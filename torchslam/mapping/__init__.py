"""Local mapping: keyframes, new map points, landmark fusion, culling, local bundle adjustment."""
