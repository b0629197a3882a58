"""KeySS, the paper's method: one model and a decoder for each key, trained jointly."""
