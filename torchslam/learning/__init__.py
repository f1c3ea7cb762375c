"""SLAM as a module to train through."""
