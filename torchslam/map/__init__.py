"""What a run knows of one world: its map, the frames posed in it, and where the camera was last."""
