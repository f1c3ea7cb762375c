"""Matches that do not belong to the static scene: moving objects and overlays."""
