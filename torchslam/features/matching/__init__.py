"""Matching of descriptors: brute force, by projection, within a radius."""
