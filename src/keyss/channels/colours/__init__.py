"""Bytes in the colours of Gaussians, which survive conversion to other formats."""
