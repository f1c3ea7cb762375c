"""One module per kind of sequence: it recognizes its layout and opens it."""
