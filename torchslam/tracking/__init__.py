"""Where is the camera now? Initialise, predict, correspond, judge, relocalise."""
