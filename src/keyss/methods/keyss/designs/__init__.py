"""The designs of KeySS; `base` is what a design has to be."""
