"""Bytes in the low bits of floats or quantised values, which survive exact copies only."""
