"""The interactive page view.html and the live viewers."""
