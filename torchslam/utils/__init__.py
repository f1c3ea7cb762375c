"""Small helpers without knowledge of SLAM."""
