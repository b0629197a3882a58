"""Gaussians as records for a channel: how a model is quantised into cells of a few dozen bytes, and back."""
