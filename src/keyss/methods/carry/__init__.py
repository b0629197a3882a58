"""The carry method: a model inside the low bits of another, without training and nearly without loss."""
