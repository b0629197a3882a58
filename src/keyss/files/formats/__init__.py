"""Formats of published models, one module each: functions `read` and `write`, or `Codes` that have both."""
