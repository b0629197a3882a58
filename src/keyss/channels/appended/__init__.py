"""Bytes in Gaussians that are appended to a model."""
