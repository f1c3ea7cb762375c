"""Kinds of sequences: each `Reader` recognizes its layout and opens it."""
