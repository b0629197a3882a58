"""The designs of KeySS, one file each, loaded when it is chosen; `base` is what a design has to be."""
