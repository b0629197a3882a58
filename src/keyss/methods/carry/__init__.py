"""The carry method: a secret as quantised Gaussians in the low bits of the cover, nearly without loss."""
