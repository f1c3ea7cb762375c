"""What a keyframe does to the map: new points, fusion, culling, local adjustment."""
