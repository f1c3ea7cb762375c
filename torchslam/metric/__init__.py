"""The unit and the attitude of a map, from measurements outside of the images."""
