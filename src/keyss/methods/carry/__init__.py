"""The carry method: a secret model as an encrypted payload in the cover."""
