"""Printed markers and boards: their definition, their detection in images, and the scale from their size."""
