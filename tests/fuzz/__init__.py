"""Inputs that are wrong in every way: good ones, what is done to them, and who reads them."""
