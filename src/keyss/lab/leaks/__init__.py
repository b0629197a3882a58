"""Attacks without the key, and the same attacks on plain models."""
