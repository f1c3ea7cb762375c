"""Printed markers and boards: what they are, where an image shows them, and what their size says of the unit."""
